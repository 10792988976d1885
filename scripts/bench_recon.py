#!/usr/bin/env python3
"""The command `lingo-mi bench-recon`, to be run from a checkout: `python scripts/bench_recon.py --help` describes it."""

from lingo_mi.cli import run

if __name__ == '__main__':
    run('bench-recon')
