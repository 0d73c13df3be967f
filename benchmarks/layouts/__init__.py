"""Comparison of electrode layouts by Cramer-Rao bounds: `eitskin bench layouts`."""
