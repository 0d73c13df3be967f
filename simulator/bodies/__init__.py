"""Bodies from surface files: bends and presses at finite strain on tetrahedra.

`tetrahedral_solid` meshes a body and orders the elimination of its unknowns, `clamped_body` bends
and `pressed_body` presses the body, `tetrahedral_field` evaluates the displacement anywhere, and
`body_store` keeps what has been solved.
"""
