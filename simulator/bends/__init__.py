"""Bends of the clamped stack: solved in 3D, stored once for each sensor, interpolated.

A scene's bend comes from a `bend_table`, solved by `bend_3d`.
"""
