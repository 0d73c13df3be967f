"""The demo: every stage from the bare sensor to a pipeline on a live board, and its report.

`command` -> `stages` (what is done, in order) -> `report` (one page from what the stages found).
"""
