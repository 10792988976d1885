"""Gain of an early stop and of pixel weights in a fit of noisy projections."""
