"""Presses and bends against reference solutions in 3D: `eitskin bench world`."""
