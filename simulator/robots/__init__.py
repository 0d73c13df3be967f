"""Skin on simulated robots: the contacts of a physics engine as touches, and frames of them.

`mujoco_skin` reads contacts of MuJoCo, `touch_table` makes touches of them and holds the
measurements of one touch.
"""
