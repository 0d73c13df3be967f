"""The commands of `eitskin`, one module each."""
