"""Measurements of the package itself, installed as `lingo_mi.studies`. The library needs none of it.

What is measured, each by a command of `lingo_mi.cli`:

    accuracy         what accuracy costs in time, of every way to compute the same projections
    benchmarks       times against a hand-written kernel, Mitsuba's tree, RTK and diffct
    effects          what modelling an effect of real projections is worth
    gradient_check   the derivatives of a scene's image against differences
    hard_cases       needles, grazing rays, coincident Gaussians: where float32 is pressed
    recipes          quality against time of fits
    tables           the paper's tables

What it is measured against, and written down with:

    oracle, closed_form     float64 references of clouds, by differences and by hand
    alternatives            other ways to compute the projections of a cloud
    pairs                   how much work an image is
    markdown, provenance    tables in documents, and how they were made
"""
