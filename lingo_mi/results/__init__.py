"""What a fit leaves behind: its numbers (`measure`), its files (`save`), its scene (`scene_file`)."""
