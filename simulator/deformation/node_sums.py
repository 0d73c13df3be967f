"""Sums of fields of many scenes at the nodes of a rectangle, as splines in its own frame."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.simulator.deformation.field import Basis, CubicSplines, Field

Array = NDArray[np.float64]
Numbers = NDArray[np.floating]
Indices = NDArray[np.int64]

DIRECT, BOTH_MIRRORED = (0, 0), (1, 1)
MIRRORED_X, MIRRORED_Y = (1, 0), (0, 1)


class NodeSums:
    """Sums of fields of scenes, each in itself or mirrored in the middle along x, y or both.

    Fields are products of functions along x, along y and over the height. They are added at nodes
    that lie symmetrically, so that an image has the values of the field in reverse. One evaluation
    at points serves all fields of a scene.

    Attributes:
        nodes: along x and y, (nx,) and (ny,) [m].
        values: of the images, (scenes, 2, 2, nx, nz, k, ny): mirrored along x or not, along y or
            not.
    """

    def __init__(
        self, nodes: tuple[Array, Array], scenes: int, levels: int, components: int
    ) -> None:
        """No fields yet, of `components` with `levels` polynomials over the height."""
        self.nodes = nodes
        shape = len(nodes[0]), levels, components, len(nodes[1])
        self.values = np.zeros((scenes, 2, 2, *shape), np.float32)

    def add(
        self,
        fields: Numbers,
        along: Numbers,
        across: Numbers,
        scenes: Indices,
        images: ArrayLike,
    ) -> None:
        """Add fields to the images of scenes.

        Args:
            fields: coefficients (n, nx', nz', k, ny').
            along: values at the nodes of the functions along x, (nx, nx') of all fields or
                (n, nx, nx') of each.
            across: likewise along y, (ny, ny') or (n, ny, ny').
            scenes: numbers (n,).
            images: whether mirrored along x and y, (n, 2) or (2,).
        """
        mirrored = np.broadcast_to(images, (len(scenes), 2))
        along, across = (each.astype(np.float32, copy=False) for each in (along, across))
        number = 4 * scenes + 2 * mirrored[:, 0] + mirrored[:, 1]
        # Factors of each field come first: there are fewer sums than fields.
        found = _placed(fields, along, across, own=True)
        first, where = np.unique(number, return_index=True)[0], np.searchsorted
        total = np.zeros((len(first), *found.shape[1:]), np.float32)
        for place, field in zip(where(first, number), found, strict=True):
            total[place] += field
        total = _placed(total, along, across, own=False)
        flat = self.values.reshape(-1, *self.values.shape[3:])
        flat[first, :, : total.shape[2]] += total

    def fields(self, height: float, scales: Array) -> list[Field]:
        """Sums of all scenes, with components (k,) times scales, on a box of a height [m]."""
        total = self.values[:, 0, 0].copy()
        for x, y in (MIRRORED_X, MIRRORED_Y, BOTH_MIRRORED):
            image = self.values[:, x, y]
            image = image[:, ::-1] if x else image
            image = image[..., ::-1] if y else image
            signs = np.ones(total.shape[3], np.float32)
            signs[0], signs[1] = 1.0 - 2.0 * x, 1.0 - 2.0 * y
            total += image * signs[:, None]
        splines = CubicSplines(self.nodes[0]), CubicSplines(self.nodes[1])
        fits = [each.fit.astype(np.float32) for each in splines]
        total = _placed(total, fits[0], fits[1], own=False)
        total *= scales.astype(np.float32)[:, None]
        found = np.moveaxis(total, -1, 2)
        return [
            Field(splines, height, each) for each in np.ascontiguousarray(found, dtype=np.float64)
        ]


def _placed(fields: Numbers, along: Numbers, across: Numbers, own: bool) -> Numbers:
    """Fields (n, nx', nz, k, ny') by those of the factors that each has of its own, or not."""
    n, nx, *between, ny = fields.shape
    if (along.ndim == 3) == own:
        nx = along.shape[-2]
        fields = np.matmul(along, fields.reshape(n, fields.shape[1], -1))
    if (across.ndim == 3) == own:
        fields = np.matmul(fields.reshape(n, -1, ny), across.swapaxes(-1, -2))
        ny = across.shape[-2]
    return fields.reshape(n, nx, *between, ny)


def functions_from(basis: Basis, nodes: Array, origins: Array) -> Numbers:
    """Values at nodes (m,) of the functions of a basis that begins at each origin, (n, m, k)."""
    values = basis.dense((nodes - origins[:, None]).ravel())
    return values.reshape(len(origins), len(nodes), -1).astype(np.float32)
