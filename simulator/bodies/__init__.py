"""Bodies from surface files: bends and presses at finite strain on tetrahedra.

`tetrahedral_solid` meshes a body and evaluates its displacement anywhere, `pressed_body` presses
it, and `body_deformation` bends it and keeps what has been solved.
"""
