"""Comparisons of time: the integrator with a hand-written kernel and Mitsuba's tree, voxel methods with RTK and diffct."""
