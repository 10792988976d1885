"""Fitting a cloud of Gaussians: settings, loss, Adam, densification, checkpoints, the loop."""
