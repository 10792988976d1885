"""What every package may use: errors, progress, arrays, the machine."""
