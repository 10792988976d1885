"""Neural attenuation fields: a density that a hash grid and a small network give at every point (NAF)."""
