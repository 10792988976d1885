"""Models of a detector's response to line integrals, without a known spectrum: a file for each small model, and `Response`,
which fits them."""
