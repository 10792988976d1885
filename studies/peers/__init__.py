"""Volumes of one scan by this package, RTK and MBIRJAX."""
