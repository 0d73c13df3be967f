"""Pipelines on sensors of worlds that they were not trained in: `eitskin bench transfer`."""
