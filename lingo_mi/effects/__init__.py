"""Effects of real projections, one a file, each used only where its element is in the scene."""
