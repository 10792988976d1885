"""The report of a result: figures and an HTML page."""
