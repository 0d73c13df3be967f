"""Presses: dents of an unbounded stack, and their corrections in the whole one.

A scene's touch takes its dent from `press_store` -> `press_table`, and its correction from
`correction_store` -> `corrections` of a `correction_table`, on a disc of a `disc_table`, on a
polygon of an `edge_table` (an `edge_field` for each side), which tells how other stacks than the
solved one differ on a rectangle too, and of a `pair_table`; all are solved by
`finite_stack` on a `stack_mesh` about the `dent_field`. `solved_press` solves a scene's presses
together instead.
"""
