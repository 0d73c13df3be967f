"""Perception pipeline: estimates from the frames of a session, and its saved form.

`pipeline.Pipeline` trains, calibrates, processes, saves and loads, whatever the method.
"""
