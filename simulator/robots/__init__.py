"""Skin on simulated robots: the contacts of a physics engine as touches, and frames of them.

`touch_rules` makes touches of points of contact, `mujoco_skin` reads those of MuJoCo,
`touch_table` holds the measurements of one touch.
"""
