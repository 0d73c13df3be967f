"""Datasets in formats of other programs: Parquet, Hugging Face, LeRobot.

The plain format stays that of `eitskin.datasets.store`; nothing here is read back.
"""
