"""The paper's experiments: `eitskin bench paper`."""
