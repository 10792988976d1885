#!/usr/bin/env python3
"""Time reconstruction on voxels against RTK and diffct on the CPU: projector, transpose, FDK, one SART iteration. The same as `lingo-mi bench-recon`."""

from lingo_mi.cli import run

if __name__ == '__main__':
    run('bench-recon')
