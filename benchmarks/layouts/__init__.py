"""Electrode layouts compared by their bounds: `eitskin bench layouts`."""
