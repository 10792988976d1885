"""The functions and classes of `import lingo_mi as lm`: data, fits, results and volumes in a few calls. `lingo_mi` loads them
lazily."""
