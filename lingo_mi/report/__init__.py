"""The report of a result: figures, and the page that holds them."""
