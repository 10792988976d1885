"""Distance between `Best`, which does not know the truth, and the best fixed settings."""
