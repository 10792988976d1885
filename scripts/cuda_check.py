#!/usr/bin/env python3
"""The study `python -m studies.cuda_check`: `python scripts/cuda_check.py --help` describes it."""

from studies.command import run_study
from studies.cuda_check import main

if __name__ == '__main__':
    run_study('cuda_check', main)
