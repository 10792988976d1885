#!/usr/bin/env python3
"""The command `lingo-mi regret`, to be run from a checkout: `python scripts/regret.py --help` describes it."""

from lingo_mi.cli import run

if __name__ == '__main__':
    run('regret')
