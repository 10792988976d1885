"""What an early stop and weights of pixels are worth to a fit of noisy projections."""
