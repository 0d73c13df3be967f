"""Report folder of an evaluation: figures, comparison with the paper, JSON and Markdown.

`folder.write_report` writes it; a module for each kind of figure draws one from an `Evaluation`.
"""
