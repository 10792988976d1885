"""Methods compared: quality against time."""
