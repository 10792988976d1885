#!/usr/bin/env python3
"""The command `lingo-mi fit`, to be run from a checkout: `python scripts/fit.py --help` describes it."""

from lingo_mi.cli import run

if __name__ == '__main__':
    run('fit')
