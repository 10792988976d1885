"""Where the Gaussians of a fit start: kinds of `start.Start`, a file each."""
