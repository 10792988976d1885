"""The paper's tables: cells, computed once and stored (`cells`), and how they are shown (`report`)."""
