"""Effects of a real tube and detector besides line integrals, as far as a scene declares them."""
