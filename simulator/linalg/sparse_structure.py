"""Structure of sparse symmetric matrices of a mesh: entries, and orders of elimination.

Blocks of a long, thin body are strips across it, which are small. For others, elements are halved
across their longest extent, and each half likewise (nested dissection, George 1973); unknowns that
two halves share are eliminated after those within the halves. For n unknowns in the plane the
factors then have of the order of n log n entries.
"""

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array
from scipy.sparse.csgraph import dijkstra

from eitskin.errors import ConfigurationError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
ElementBlocks = tuple[Sequence[Array], Sequence[Array], Sequence[Array]]
"""Blocks of symmetric element matrices of k cells: (k, f, f) between the nodal displacements in
directions (i, j), j >= i; (k, f, m) between displacements in direction i and pressures; and
(k, m, m) between pressures, a single one."""
OrderName = Literal["block Cholesky", "nested dissection"]

# Sum of the cubed strip sizes per matrix entry at which both orders take equally long: strips were
# faster below 1.3e3 and dissection above 2e3, on rectangles and discs of 3,000 to 27,000 unknowns.
_STRIP_WORK = 1.5e3
# of the extent, by which positions of elements next to each other differ
_POSITION_TOLERANCE = 1e-6
_LEAF = 240  # unknowns, about, whose elements are not dissected further


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Unknowns eliminated together, after the blocks that they separate.

    Attributes:
        own: the unknowns.
        within: numbers, in the order of elimination, of the blocks that these unknowns separate.
    """

    own: Indices
    within: tuple[int, ...]


def choose_order(
    name: str | None,
    positions: tuple[Indices, Indices],
    numbers: Indices,
    middles: NDArray[np.float64],
) -> tuple[OrderName, list[Block]]:
    """The order called `name`, or the faster one for the shape of the body.

    Raises ConfigurationError for another name.

    Args:
        name: "block Cholesky", by strips; "nested dissection"; or None. "sparse LU", of earlier
            versions, is nested dissection.
        positions: rows and columns of the matrix entries.
        numbers: unknowns of each element, (elements, functions).
        middles: middles of the elements, (elements, axes) [m]; strips begin where the first is
            lowest.
    """
    if name == "sparse LU":
        warnings.warn(
            'solver="sparse LU" is deprecated; use "nested dissection", which is faster',
            DeprecationWarning,
            stacklevel=3,
        )
        name = "nested dissection"
    if name is not None and name not in get_args(OrderName):
        raise ConfigurationError(
            f"solver must be one of {get_args(OrderName)} or None, got {name!r}"
        )
    if name != "nested dissection":
        x = middles[:, 0]
        level = level_structure(
            numbers, np.flatnonzero(x <= x.min() + _POSITION_TOLERANCE * np.ptp(x))
        )
        work = float((np.bincount(level).astype(float) ** 3).sum())
        if name is not None or work <= _STRIP_WORK * len(positions[0]):
            return "block Cholesky", strips(*positions, level)
    return "nested dissection", dissection(numbers, middles)


def level_structure(numbers: Indices, first: Indices) -> Indices:
    """Strip of each unknown, (unknowns,): level of a breadth-first search from elements `first`.

    Args:
        numbers: unknowns of each element, (elements, functions).
        first: elements of level 0.

    An element then has unknowns of two consecutive strips at most, on any mesh (level structure,
    George and Liu 1981). Raises ConfigurationError for a mesh that is not connected.
    """
    elements, functions = numbers.shape
    nodes = elements + int(numbers.max()) + 1  # of a graph of elements and their unknowns
    shares = (np.repeat(np.arange(elements), functions), elements + numbers.ravel())
    graph = coo_array((np.ones(numbers.size), shares), (nodes, nodes)).tocsr()
    steps = dijkstra(graph, directed=False, indices=first, unweighted=True, min_only=True)
    if not np.isfinite(steps).all():
        raise ConfigurationError(
            "expected a sensor of one connected body, got parts that do not touch; join them in "
            "the design"
        )
    level: Indices = steps[elements:].astype(np.int64) // 2
    return level


def strips(rows: Indices, columns: Indices, strip: Indices) -> list[Block]:
    """Blocks of strips, which matrix entries at (rows, columns) couple to the next one at most.

    The unknowns of a strip that are coupled to the next one come last in its block.
    """
    crossing = strip[rows] != strip[columns]
    lower_end = np.where(strip[rows] < strip[columns], rows, columns)[crossing]
    coupled = np.zeros(len(strip), dtype=bool)
    coupled[lower_end] = True
    order = np.lexsort((coupled, strip))
    parts = np.split(order, np.flatnonzero(np.diff(strip[order])) + 1)
    return [Block(own, (number - 1,) if number else ()) for number, own in enumerate(parts)]


def dissection(numbers: Indices, middles: NDArray[np.float64]) -> list[Block]:
    """Blocks of unknowns by nested dissection of the elements.

    Args:
        numbers: unknowns of each element, (elements, functions); -1 for none.
        middles: middles of the elements, (elements, axes) [m].
    """
    numbers = numbers + 1
    elements_of = np.bincount(numbers.ravel())
    leaf = max(1, _LEAF * len(numbers) // len(elements_of))
    blocks: list[Block] = []
    turn, leaves = np.full(len(elements_of), len(numbers)), count()

    def dissect(elements: Indices) -> tuple[tuple[int, ...], Indices, Indices]:
        """Last blocks, border, and number of elements of each border unknown."""
        if len(elements) <= leaf:
            last: tuple[int, ...] = ()
            unknowns, shares = np.unique(numbers[elements], return_counts=True)
            turn[unknowns] = np.minimum(turn[unknowns], next(leaves))
        else:
            axis = int(np.ptp(middles[elements], axis=0).argmax())
            rising = elements[np.argsort(middles[elements, axis], kind="stable")]
            cut = _middle(middles[rising, axis])
            halves = [dissect(half) for half in (rising[:cut], rising[cut:])]
            last = halves[0][0] + halves[1][0]
            borders = np.concatenate([border for _, border, _ in halves])
            unknowns, numbered = np.unique(borders, return_inverse=True)
            shares = np.zeros(len(unknowns), dtype=np.int64)
            np.add.at(shares, numbered, np.concatenate([shares for *_, shares in halves]))
        whole = shares == elements_of[unknowns]  # no element elsewhere has these unknowns
        own = unknowns[whole & (unknowns > 0)] - 1
        if len(own):
            # Neighbours follow each other, and stay together in the borders of blocks within.
            blocks.append(Block(own[np.argsort(turn[own + 1], kind="stable")], last))
            last = (len(blocks) - 1,)
        return last, unknowns[~whole], shares[~whole]

    dissect(np.arange(len(numbers)))
    return blocks


def _middle(rising: NDArray[np.float64]) -> int:
    """Number at which rising positions are halved: between two that differ, where any do."""
    steps = np.flatnonzero(np.diff(rising) > _POSITION_TOLERANCE * (rising[-1] - rising[0])) + 1
    half = len(rising) // 2
    return int(steps[np.abs(steps - half).argmin()]) if len(steps) else half


class StiffnessPattern:
    """Sparsity pattern of symmetric matrices of displacements, node by node, then pressures.

    To sort the entries of all element matrices takes longer than to evaluate them. Their numbers
    in the assembled matrix are therefore found once, and for pairs of nodes, which all directions
    share: these numbers need little memory.
    """

    def __init__(self, nodes: Indices, pressures: Indices, dim: int) -> None:
        """Number the entries of a mesh.

        Args:
            nodes: numbers of the displacement nodes of each cell, (cells, f).
            pressures: numbers of the pressures of each cell, from 0, (cells, m).
            dim: directions of the displacements.
        """
        self._pairs = (_Pairs(nodes, nodes), _Pairs(nodes, pressures), _Pairs(pressures, pressures))
        # Directions of rows and columns of each block; that of pressures is `dim`.
        self._directions = (
            [(i, j) for i in range(dim) for j in range(i, dim)],
            [(i, dim) for i in range(dim)],
            [(dim, dim)],
        )
        first = dim * (int(nodes.max()) + 1)
        rows, columns, sums, count = [], [], [], 0
        for pairs, directions in zip(self._pairs, self._directions, strict=True):
            for i, j in directions:
                row, column = (
                    first + numbers if k == dim else dim * numbers + k
                    for numbers, k in ((pairs.rows, i), (pairs.columns, j))
                )
                own = np.arange(count, count + len(row), dtype=np.int32)
                count += len(row)
                # Pairs of one direction come in both orders; the other blocks are mirrored.
                for row_part, column_part in ((row, column), (column, row))[: 1 if i == j else 2]:
                    rows.append(row_part)
                    columns.append(column_part)
                    sums.append(own)
        entries = (np.concatenate(rows), np.concatenate(columns))
        pattern = coo_array((np.concatenate(sums), entries)).tocsc()
        self._sum_of_entry, self._rows, self._ends = pattern.data, pattern.indices, pattern.indptr
        self._rows.flags.writeable = False  # all matrices share this array

    def assemble(self, elements: Iterable[tuple[Indices, ElementBlocks]], size: int) -> csc_array:
        """Sum (size, size) of the matrices of cells, given as chunks of cells and their blocks.

        Unknowns after the pressures have no entries.
        """
        sums = [
            np.zeros((len(directions), len(pairs.rows)))
            for pairs, directions in zip(self._pairs, self._directions, strict=True)
        ]
        for cells, parts in elements:
            for pairs, totals, blocks in zip(self._pairs, sums, parts, strict=True):
                numbers = pairs.numbers[cells].ravel()
                for total, block in zip(totals, blocks, strict=True):
                    np.add.at(total, numbers, block.ravel())
        values = np.concatenate([total.ravel() for total in sums])[self._sum_of_entry]
        ends = np.pad(self._ends, (0, size + 1 - len(self._ends)), mode="edge")
        matrix = csc_array((values, self._rows, ends), shape=(size, size))
        matrix.has_canonical_format = True
        return matrix


class _Pairs:
    """Pairs of numbers that share a cell.

    Attributes:
        rows, columns: the pairs, (pairs,).
        numbers: numbers of the pairs of each cell, (cells, rows, columns).
    """

    def __init__(self, rows: Indices, columns: Indices) -> None:
        count = int(rows.max()) + 1
        keys = columns[:, None, :] * count + rows[:, :, None]
        pairs, numbers = np.unique(keys, return_inverse=True)
        self.columns, self.rows = np.divmod(pairs, count)
        self.numbers = numbers.reshape(keys.shape).astype(np.int32)
