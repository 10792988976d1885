#!/usr/bin/env python3
"""The command `lingo-mi compare`, to be run from a checkout: `python scripts/compare.py --help` describes it."""

from lingo_mi.cli import run

if __name__ == '__main__':
    run('compare')
