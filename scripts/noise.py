#!/usr/bin/env python3
"""The command `lingo-mi noise`, to be run from a checkout: `python scripts/noise.py --help` describes it."""

from lingo_mi.cli import run

if __name__ == '__main__':
    run('noise')
