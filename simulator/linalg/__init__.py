"""Assembly and direct solvers of sparse symmetric systems.

`sparse_solvers` chooses between block Cholesky and sparse LU for the forward model;
`two_sided_elimination` caches the Schur complements that reanalysis reuses; `nested_dissection`
serves the three-dimensional press; `stiffness_pattern` assembles what nonlinear solves factorise.
"""
