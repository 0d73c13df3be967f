"""Blocks cut into cells of any kind, and the area that electrodes cover on them."""

import numpy as np

# A hexahedron as two wedges, and as six tetrahedra around its long diagonal 0-6 (Kuhn).
AS_WEDGES = np.array([[0, 1, 2, 4, 5, 6], [0, 2, 3, 4, 6, 7]])
AS_TETRAHEDRA = np.array(
    [[0, 1, 2, 6], [0, 2, 3, 6], [0, 3, 7, 6], [0, 7, 4, 6], [0, 4, 5, 6], [0, 5, 1, 6]]
)


def block(kind, counts, size):
    """Points and cells of a block at the origin, cut into cells with `kind` corners each."""
    lines = [np.linspace(0.0, s, n + 1) for s, n in zip(size, counts, strict=True)]
    points = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(len(points)).reshape([n + 1 for n in counts])
    plane = [number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]]
    corners = [p[..., :-1] for p in plane] + [p[..., 1:] for p in plane]
    cells = np.stack(corners, axis=-1).reshape(-1, 8)
    if kind == 6:
        cells = cells[:, AS_WEDGES].reshape(-1, 6)
    if kind == 4:
        cells = cells[:, AS_TETRAHEDRA].reshape(-1, 4)
    return points, cells


def covered(mesh, count):
    """Area of each of `count` electrodes by the corners of its pieces, as they lie."""
    corners = mesh.contacts.corners
    edges = corners[:, [1, -1]] - corners[:, :1]
    areas = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    areas *= 0.5 if corners.shape[1] == 3 else 1.0
    return np.bincount(mesh.contacts.electrode, areas, minlength=count)
