"""Scans, volumes, poses, images and clouds on disk: one reader and writer for every format. No Mitsuba."""
