"""What `import lingo_mi as lm` offers: data, fits, results and volumes in a few calls. Loaded lazily by `lingo_mi`."""
