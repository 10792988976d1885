"""Which errors of a scanner explain what a reconstruction leaves of a measured scan."""
