"""Speed of simulation, generation and pipeline: `eitskin bench speed`."""
