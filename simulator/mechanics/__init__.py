"""Solid mechanics of the encapsulated gel: materials, layers, equilibrium, contact, relaxation.

`mixed_solid` is the nearly incompressible solid of a `materials` law, `load_stepping` finds its
equilibrium and a contact of its `face` presses it. `axisymmetric_press` solves an indenter on an
unbounded `layer_stack`, and `viscoelasticity` adds time.
"""
