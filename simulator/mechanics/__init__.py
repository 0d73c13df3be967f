"""Solid mechanics of the encapsulated gel: materials, equilibrium, presses and bends.

Scenes use `press_store` -> `press_table` -> `axisymmetric_press`, solved once for an indenter and
stack, with `viscoelasticity` for time and `closed_form_dent` where nothing is to be solved.
`press_3d` and `bend_3d` are the full models that the others are compared with. All stand on
`materials`, `mixed_solid`, `penalty_contact` and `load_stepping`.
"""
