"""Assembly and direct solvers of sparse symmetric systems.

`sparse_solvers` chooses between block Cholesky and sparse LU for the forward model;
`element_products` multiplies by matrices that are not assembled, for reanalysis;
`nested_dissection` serves the three-dimensional press; `stiffness_pattern` assembles the matrices
that nonlinear solves factorise.
"""
