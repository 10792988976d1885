#!/usr/bin/env python3
"""The command `lingo-mi peers`, to be run from a checkout: `python scripts/peers.py --help` describes it."""

from lingo_mi.cli import run

if __name__ == '__main__':
    run('peers')
