"""Results and scans in napari: `reader` opens files, `widget` fits a scan and shows the volume as it grows."""
