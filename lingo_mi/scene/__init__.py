"""From a Mitsuba scene to a scan: load, check, simulate, and sample the true volume."""
