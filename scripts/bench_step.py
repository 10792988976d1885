#!/usr/bin/env python3
"""The command `lingo-mi bench-step`, to be run from a checkout: `python scripts/bench_step.py --help` describes it."""

from lingo_mi.cli import run

if __name__ == '__main__':
    run('bench-step')
