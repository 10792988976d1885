"""Corrections that are fitted with the cloud: a file for each kind of `correction.Correction`."""
