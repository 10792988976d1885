#!/usr/bin/env python3
"""Measure what accuracy costs: error, time and memory of every way to compute the same projections, scaling, and fits. The same as `lingo-mi accuracy`."""

from lingo_mi.cli import run

if __name__ == '__main__':
    run('accuracy')
