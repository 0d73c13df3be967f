"""The demo: every stage from the bare sensor to a pipeline on a live board, and its report.

`command` runs the `stages` in their order, and makes one page of their numbers and pictures.
"""
