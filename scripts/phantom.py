#!/usr/bin/env python3
"""Make a test object and, if asked, a noise-free scan of it. The same as `lingo-mi phantom`."""

from lingo_mi.cli import run

if __name__ == '__main__':
    run('phantom')
