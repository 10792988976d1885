"""How far `Best`, which knows no truth, is behind the best of fixed settings."""
