#!/usr/bin/env python3
"""The command `lingo-mi inspect`, to be run from a checkout: `python scripts/inspect_scan.py --help` describes it."""

from lingo_mi.cli import run

if __name__ == '__main__':
    run('inspect')
