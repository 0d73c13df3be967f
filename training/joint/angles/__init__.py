"""Bend angle of an untouched sensor: by its bend curve, and by networks for clamps of any kind."""
