#!/usr/bin/env python3
"""Check the derivatives of a scene's image against differences: a table of AD, differences and their relative error. The same as `lingo-mi gradcheck`."""

from lingo_mi.cli import run

if __name__ == '__main__':
    run('gradcheck')
