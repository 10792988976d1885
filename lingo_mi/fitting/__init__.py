"""Fitting a cloud of Gaussians: settings and recipes, forward models, loss, Adam, densification, checkpoints, the loop."""
