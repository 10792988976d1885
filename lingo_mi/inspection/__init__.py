"""A look at a scan before work: what its projections say of air, noise, truncation, order, angles and axis. NumPy."""
