#!/usr/bin/env python3
"""The command `lingo-mi cuda-check`, to be run from a checkout: `python scripts/cuda_check.py --help` describes it."""

from lingo_mi.cli import run

if __name__ == '__main__':
    run('cuda-check')
