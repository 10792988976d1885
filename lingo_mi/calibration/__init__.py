"""Calibration of a scan by its own projections: quick reconstructions find the place of the panel before a fit."""
