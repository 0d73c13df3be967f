"""The commands `eitskin bench ...`, one module each."""
