"""The methods, a file each: `LINGO`, the baselines that it is compared with, and this package's own `Fast`."""
