"""Benchmarks behind `eitskin bench`: errors and run times of the package."""
