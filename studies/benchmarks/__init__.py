"""Times against others: the integrator against a hand-written kernel and Mitsuba's tree, voxels against RTK and diffct."""
