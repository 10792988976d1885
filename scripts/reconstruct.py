#!/usr/bin/env python3
"""Reconstruct a CT volume from projections, measured or simulated, or completed from a fitted cloud. The same as `lingo-mi reconstruct`."""

from lingo_mi.cli import run

if __name__ == '__main__':
    run('reconstruct')
