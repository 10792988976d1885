#!/usr/bin/env python3
"""Regenerate the paper's tables: new views, CT reconstruction in two stages, and the parts of LINGO. The same as `lingo-mi tables`."""

from lingo_mi.cli import run

if __name__ == '__main__':
    run('tables')
