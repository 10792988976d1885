#!/usr/bin/env python3
"""The command `lingo-mi phantom`, to be run from a checkout: `python scripts/phantom.py --help` describes it."""

from lingo_mi.cli import run

if __name__ == '__main__':
    run('phantom')
