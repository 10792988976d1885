"""From a scanner's own files to line integrals: frames, dark and flat fields, bad pixels, noise. NumPy, file by file."""
