#!/usr/bin/env python3
"""Compare recipes: quality against time, for every scene and method, as curves and a table. The same as `lingo-mi recipes`."""

from lingo_mi.cli import run

if __name__ == '__main__':
    run('recipes')
