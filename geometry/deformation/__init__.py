"""Deformations of the layer: kinematics, bending fixtures, twist and roll.

`kinematics` defines a deformation, its composition, flexures and the pull-back of conductivity;
`fixtures` find the parameters of bends, roll and twist.
"""
