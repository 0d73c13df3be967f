"""Displacement fields of corrections: splines on boxes, turned, mirrored and added."""
