"""Recipes: description of datasets, and random sampling of specimens, scenes and episodes.

A `recipe` has `specimen`s, `scene_group`s and `episode`s; `frame_sampling` draws frame i from them.
"""
