"""What a real detector sees besides line integrals; only where a scene calls for it."""
