"""Sums of tables, and of the fields of many scenes at the nodes of a rectangle."""

from collections.abc import Iterable
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.simulator.deformation.field import Basis, CubicSplines, Field
from eitskin.simulator.deformation.solution_table import SolutionTable, product_in_blocks

Array = NDArray[np.float64]
Numbers = NDArray[np.floating]
Indices = NDArray[np.int64]

DIRECT, BOTH_MIRRORED = (0, 0), (1, 1)
MIRRORED_X, MIRRORED_Y = (1, 0), (0, 1)
_AT_ONCE = 16  # fields that are added together


class NodeSums:
    """Sums of fields of scenes, each in itself or mirrored in the middle along x, y or both.

    Fields are products of functions along x, along y and over the height. They are added at nodes
    that lie symmetrically, so that an image has the values of the field in reverse. One evaluation
    at points serves all fields of a scene.

    Attributes:
        nodes: positions along x and y, (nx,) and (ny,) [m].
        values: values at the nodes, (scenes, nx, nz, k, ny).
    """

    def __init__(
        self, nodes: tuple[Array, Array], scenes: int, levels: int, components: int
    ) -> None:
        """No fields yet, of `components` with `levels` polynomials over the height."""
        self.nodes = nodes
        shape = len(nodes[0]), levels, components, len(nodes[1])
        self.values = np.zeros((scenes, *shape), np.float32)

    @property
    def components(self) -> int:
        """Number k of components."""
        return self.values.shape[3]

    def add(
        self,
        modes: Numbers,
        amounts: Array,
        along: Numbers,
        across: Numbers,
        scenes: Indices,
        images: ArrayLike = DIRECT,
        turns: Numbers | None = None,
    ) -> None:
        """Add fields to scenes, or mirror images of them.

        Args:
            modes: coefficients (r, nx', nz', k, ny').
            amounts: amounts of the modes in each field, (n, r).
            along: values at the nodes of the functions along x, (nx, nx') of all fields or
                (n, nx, nx') of each.
            across: likewise along y, (ny, ny') or (n, ny, ny').
            scenes: numbers (n,).
            images: whether mirrored along x and y, (n, 2) or (2,).
            turns: matrices that turn the components of each field or image, (n, 3, 3).
        """
        along, across = (each.astype(np.float32, copy=False) for each in (along, across))
        mirrored = np.broadcast_to(images, (len(scenes), 2))
        number = 4 * scenes + 2 * mirrored[:, 0] + mirrored[:, 1]
        slots, slot = np.unique(number, return_inverse=True)
        if turns is not None:  # images are turned as the fields are before they are mirrored
            signs = np.ones((len(scenes), 3, 1), np.float32)
            signs[:, :2, 0] -= 2.0 * mirrored
            turns = (signs * turns * signs.swapaxes(1, 2))[:, None, None]
        # Factors of each field come first: there are fewer sums than fields.
        total: Numbers = np.zeros(0, np.float32)
        for start in range(0, len(amounts), _AT_ONCE):
            rows = slice(start, start + _AT_ONCE)
            fields = product_in_blocks(amounts[rows], modes.reshape(len(modes), -1))
            fields = fields.reshape(-1, *modes.shape[1:])
            if turns is not None:
                fields[..., :3, :] = turns[rows] @ fields[..., :3, :]
            own = (each[rows] if each.ndim == 3 else None for each in (along, across))
            fields = _combine_fields(fields, *own)
            total = total if total.size else np.zeros((len(slots), *fields.shape[1:]), np.float32)
            for place, field in zip(slot[rows].tolist(), fields, strict=True):
                total[place] += field
        total = _combine_fields(
            total, *(each if each.ndim == 2 else None for each in (along, across))
        )
        levels = modes.shape[2]
        for row, place in enumerate(slots.tolist()):
            image = mirror(total[row], (place // 2 % 2, place % 2))
            self.values[place // 4, :, :levels] += image

    def fields(self, height: float, scales: Array) -> list[Field]:
        """Sums of all scenes, with components (k,) times scales, on a box of a height [m]."""
        splines = CubicSplines(self.nodes[0]), CubicSplines(self.nodes[1])
        total = _combine_fields(self.values, *(spline.fit.astype(np.float32) for spline in splines))
        total *= scales.astype(np.float32)[: self.components, None]
        fields = np.ascontiguousarray(np.moveaxis(total, -1, 2), dtype=np.float64)
        return [Field(splines, height, each) for each in fields]


def mirror(fields: Numbers, axes: tuple[int, int], polynomials: bool = False) -> Numbers:
    """Mirror images along x, y or both of fields (..., nx, nz, k, ny) by values at nodes.

    Or by coefficients, either of splines or of polynomials.
    """
    signs = np.ones((fields.shape[-2], 1), fields.dtype)
    for axis, place in ((0, -4), (1, -1)):
        if axes[axis]:
            signs[axis] = -1.0
            if polynomials:
                odd = np.where(np.arange(fields.shape[place]) % 2, -1.0, 1.0)
                fields = fields * odd.astype(fields.dtype).reshape(-1, *(1,) * (-1 - place))
            else:
                fields = np.flip(fields, place)
    return fields * signs


def basis_values(basis: Basis, nodes: Array, origins: Array) -> Numbers:
    """Values at nodes (m,) of the functions of a basis that begins at each origin, (n, m, k)."""
    values = basis.dense((nodes - origins[:, None]).ravel())
    return values.reshape(len(origins), len(nodes), -1).astype(np.float32)


def _combine_fields(fields: Numbers, along: Numbers | None, across: Numbers | None) -> Numbers:
    """Fields (n, nx', nz, k, ny') by values of their functions along x and y, where given."""
    n, nx, *between, ny = fields.shape
    if along is not None:
        fields, nx = np.matmul(along, fields.reshape(n, nx, -1)), along.shape[-2]
    if across is not None:
        fields = np.matmul(fields.reshape(n, -1, ny), across.swapaxes(-1, -2))
        ny = across.shape[-2]
    return fields.reshape(n, nx, *between, ny)


class TableSum:
    """Sum of tables of one kind with weights.

    Heights of fields count over the gel's, stresses over its modulus, and coefficients are on the
    functions of the base.

    Attributes:
        modes: modes of all tables and of all their images, (modes, nx, nz, k, ny).
    """

    def __init__(
        self,
        base: SolutionTable,
        tables: tuple[SolutionTable, ...],
        components: int,
        images: tuple[tuple[int, int], ...] = (DIRECT,),
    ) -> None:
        self._tables, modes = tables, []
        for table in tables:
            own = np.array([1.0, 1.0, 1.0 / table.size("height"), 1.0 / table.size("modulus")])
            coefficients = (table.modes * (table.scales * own).astype(np.float32))[..., :components]
            coefficients = np.moveaxis(_resample_splines(coefficients, table, base), 2, -1)
            polynomials = "along" not in base.sizes and "nodes" not in base.sizes
            modes += [mirror(coefficients, image, polynomials) for image in images]
        self.modes = np.concatenate(modes).astype(np.float32)

    @cached_property
    def transposed_modes(self) -> Numbers:
        """Modes with x and y changed for each other, (modes, ny, nz, k, nx)."""
        order = [1, 0, *range(2, self.modes.shape[3])]
        return np.ascontiguousarray(self.modes.swapaxes(1, 4)[:, :, :, order])

    def amounts(
        self, weights: Iterable[float], height: float, **parameters: Array
    ) -> tuple[Array, Array]:
        """Amounts of the modes (t, modes) and extra depths (t,) [m] under a gel of a height [m].

        At parameters (t,), among them may be a depth [m].
        """
        amounts, extra = [], np.zeros(1)
        for table, weight in zip(self._tables, weights, strict=True):
            higher = height / table.size("height")
            own = {k: at / higher if k == "depth" else at for k, at in parameters.items()}
            found, numbers = table.amounts(**own)
            amounts += [weight * each for each in found.reshape(-1, *found.shape[-2:])]
            extra = extra + weight * higher * numbers["extra_depth"]
        return np.concatenate(amounts, axis=-1), extra

    def fields(self, amounts: Array) -> Numbers:
        """Coefficients (t, nx, ny, nz, k) of amounts of the modes (t, modes)."""
        fields = product_in_blocks(amounts, self.modes.reshape(len(self.modes), -1))
        return np.moveaxis(fields.reshape(-1, *self.modes.shape[1:]), -1, 2)


# Sums are as large as all their tables, and those of a nominal sensor serve all its specimens.
sum_of = lru_cache(maxsize=32)(TableSum)


def _resample_splines(coefficients: Numbers, table: SolutionTable, base: SolutionTable) -> Numbers:
    """Coefficients (t, nx, ny, nz, k) of a table next to a side, on the splines of another."""
    if table is base or (
        np.array_equal(table.sizes["along"], base.sizes["along"])
        and np.array_equal(table.sizes["inward"], base.sizes["inward"])
    ):
        return coefficients
    moved = table.size("middle") - base.size("middle")
    along, inward = (
        CubicSplines(new).fit @ CubicSplines(own).dense(new)
        for own, new in (
            (table.sizes["along"], base.sizes["along"]),
            (table.sizes["inward"] + moved, base.sizes["inward"]),
        )
    )
    return np.asarray(np.einsum("ai,bj,tijlk->tablk", along, inward, coefficients, optimize=True))
