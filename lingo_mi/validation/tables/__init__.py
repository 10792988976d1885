"""The paper's tables: cells, computed once and stored (`cells`), and their presentation (`report`)."""
