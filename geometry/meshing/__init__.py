"""Meshes of the conductive layer, refined at the electrode edges.

`mesh_design` makes hexahedra, prisms (by way of `delaunay`) or `tetrahedra`; `grading` says the
cell sizes, and `mesh` refuses bad cells.
"""
