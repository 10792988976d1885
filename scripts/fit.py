#!/usr/bin/env python3
"""Fit a cloud of 3D Gaussians to a CT scan, and make a volume and new views of it. The same as `lingo-mi fit`."""

from lingo_mi.cli import run

if __name__ == '__main__':
    run('fit')
