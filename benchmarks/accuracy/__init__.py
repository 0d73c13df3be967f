"""Error against run time of the forward model: `eitskin bench accuracy`."""
