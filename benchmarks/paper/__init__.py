"""Experiments of the paper: `eitskin bench paper`."""
