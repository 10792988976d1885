#!/usr/bin/env python3
"""The command `lingo-mi hard-cases`, to be run from a checkout: `python scripts/hard_cases.py --help` describes it."""

from lingo_mi.cli import run

if __name__ == '__main__':
    run('hard-cases')
