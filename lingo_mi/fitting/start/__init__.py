"""Initial Gaussians of a fit: a file for each kind of `start.Start`."""
