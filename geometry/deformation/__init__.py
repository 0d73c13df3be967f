"""Deformations of the layer: kinematics, bending fixtures, twist and roll.

`kinematics` defines a deformation, its composition and the pull-back of conductivity; `flexure`
bends a layer by any curvature, `fixtures` find its parameters, `twist` adds torsion and rolling.
"""
