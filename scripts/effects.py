#!/usr/bin/env python3
"""The command `lingo-mi effects`, to be run from a checkout: `python scripts/effects.py --help` describes it."""

from lingo_mi.cli import run

if __name__ == '__main__':
    run('effects')
