#!/usr/bin/env python3
"""Measure the hard cases of the tests: a Markdown table of their errors, refusals and warnings. The same as `lingo-mi hard-cases`."""

from lingo_mi.cli import run

if __name__ == '__main__':
    run('hard-cases')
