"""Deformations of the layer: kinematics, bending fixtures, twist and roll.

`kinematics` defines a deformation, its composition and the pull-back of conductivity; `flexure`
bends a layer, `fixtures` find the parameters of bends, roll and twist.
"""
