"""The report folder of an evaluation: figures, the table of the paper, and both as one page."""
