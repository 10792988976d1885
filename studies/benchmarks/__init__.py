"""Times of a step of a fit, of voxel methods beside RTK and diffct, of neural fields and of arrays."""
