"""Volumes from a fit: views that were not measured are rendered from it, or its volume is the start."""
