"""Measurements of error against run time; every published figure comes from one of these."""
