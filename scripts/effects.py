#!/usr/bin/env python3
"""Measure what modelling the effects of real projections is worth: fits that ignore them against fits that model them. The same as `lingo-mi effects`."""

from lingo_mi.cli import run

if __name__ == '__main__':
    run('effects')
