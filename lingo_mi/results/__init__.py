"""Observers of fits: a page and a log that grow during a fit, and a page that compares several fits."""
