"""Deformations of the layer: kinematics, bending fixtures, twist and roll."""
