"""Complete electrode model: from a conductivity to the impedances between electrodes.

`elements` and `function_space` hold the shape functions, `assembly` the matrices, `cem_system` the
linear system, `forward_model` the solution and its adjoint Jacobians, `batch` many scenes by
the factors of one.
"""
