#!/usr/bin/env python3
"""The command `lingo-mi reconstruct`, to be run from a checkout: `python scripts/reconstruct.py --help` describes it."""

from lingo_mi.cli import run

if __name__ == '__main__':
    run('reconstruct')
