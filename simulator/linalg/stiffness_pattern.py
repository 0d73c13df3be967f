"""Sparsity pattern of the stiffness of mixed elements, numbered once for all assemblies."""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

ElementBlocks = tuple[Sequence[Array], Sequence[Array], Sequence[Array]]
"""Blocks of symmetric element matrices of k cells: (k, f, f) between the nodal displacements in
directions (i, j), j >= i; (k, f, m) between displacements in direction i and pressures; and
(k, m, m) between pressures, a single one."""


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
