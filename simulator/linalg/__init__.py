"""Assembly and direct solvers of sparse symmetric systems.

`sparse_solvers` chooses between `block_cholesky` and `multifrontal_cholesky` for the forward model;
`sparse_lu` serves complex matrices;
`element_products` multiplies by matrices that are not assembled, for reanalysis;
`nested_dissection` serves the three-dimensional press; `stiffness_pattern` assembles the matrices
that nonlinear solves factorise.
"""
