"""A cohort: a list of scans (`listing`), each fitted into a folder of its own (`work`), and a table of results (`table`)."""
