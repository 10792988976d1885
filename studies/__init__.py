"""Measurements of the package itself, installed as `lingo_mi.studies`: what accuracy costs, the paper's tables, peers."""
