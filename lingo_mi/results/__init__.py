"""What is shown of fits: a page and a log that grow while one runs, and a page of several side by side."""
