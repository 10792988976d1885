"""Results of a fit: its numbers (`measure`), its files (`save`), its scene (`scene_file`)."""
