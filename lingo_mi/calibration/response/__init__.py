"""What a detector makes of line integrals, without a known spectrum: one small model a file, and `Response`, which fits them."""
