"""Measurements of the package itself, installed as `lingo_mi.studies`. The library needs none of it.

What is measured, each by a command of `lingo_mi.cli`:

    accuracy         error against time, for all ways to compute the same projections
    benchmarks       times against a hand-written kernel, Mitsuba's tree, RTK and diffct
    effects          gain from modelling an effect of real projections
    fuzz             mutated files for every reader
    gradient_check   the derivatives of a scene's image against finite differences
    hard_cases       needles, grazing rays, coincident Gaussians: cases at the limits of float32
    recipes          quality of fits against time
    tables           the paper's tables

What it is measured against, and written down with:

    oracle, closed_form     float64 references of clouds, by differences and by hand
    alternatives            other ways to compute the projections of a cloud
    pairs                   how much work an image is
    markdown, provenance    tables in documents, and how they were made
"""
