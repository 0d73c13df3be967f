"""Stiff and extreme cases: `eitskin bench stability`."""
