"""Meshes of the conductive layer, refined at the electrode edges.

`mesh_design` chooses between `hexahedra`, `prisms` (by way of `delaunay`) and `tetrahedra` (with
`snapping`); `grading` says the cell sizes, and `quality` refuses bad cells.
"""
