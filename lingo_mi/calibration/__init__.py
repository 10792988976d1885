"""What a scan says of its own errors: the panel's place, found by quick reconstructions before a fit."""
