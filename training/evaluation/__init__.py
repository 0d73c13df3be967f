"""Evaluation of pipelines on datasets: metrics, scores, report folders, Cramer-Rao bounds.

`evaluate.Evaluation` compares predictions with the truth; `report` draws and writes the results.
"""
