"""Errors of a scanner that explain the residual of a measured scan's reconstruction."""
