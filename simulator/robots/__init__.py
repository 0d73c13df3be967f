"""Skin on simulated robots: the contacts of a physics engine as touches, and frames of them.

`mujoco_skin` reads contacts of MuJoCo, makes touches of them, and measures these.
"""
