#!/usr/bin/env python3
"""Time the integrator, forward and backward, against a kernel written by hand for this job and against Mitsuba's tree. The same as `lingo-mi bench`."""

from lingo_mi.cli import run

if __name__ == '__main__':
    run('bench')
