"""From a Mitsuba scene to a scan: load, check, simulate, and the truth on voxels."""
