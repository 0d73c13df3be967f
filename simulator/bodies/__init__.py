"""Bodies from surface files: bends and presses at finite strain on tetrahedra.

`tetrahedral_solid` meshes a body and evaluates its displacement anywhere, `clamped_body` bends and
`pressed_body` presses the body, and `body_deformation` keeps what has been solved.
"""
