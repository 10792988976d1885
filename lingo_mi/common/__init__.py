"""Tools of every package: errors, progress, arrays, the machine."""
