"""Deformation of the sensor by touches, from solved tables or solved in 3D.

`touches` turns the touches of a scene into dents of the unbounded stack, by a `press_table`, and
their `corrections` in the finite one, each a `field`. `dents` adds both up to a deformation, and
`deformed_layer` pulls the conductivity back to the flat layer. Tables are solved by
`indentation_tables` and `press_table` once, for the sensors of a `sensor_grid`, and kept by the
`solution_store`. `finite_stack` solves the touches of one scene together instead.
"""
