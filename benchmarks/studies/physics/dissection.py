"""Nested dissection of a wide, thin elastic layer, beside SuperLU.

Run by `python -m eitskin.benchmarks.studies.physics.dissection [CELLS ...]`.

Prints, as Markdown, for layers of CELLS x CELLS x 4 quadratic hexahedra with three displacements at
each node, clamped below: time of one factorisation, memory of its factors, and residual of one
solution, by `simulator.linalg.nested_dissection` and by SuperLU with the same ordering.
"""

import argparse
import time
from collections.abc import Callable
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, kron
from scipy.sparse.linalg import splu

from eitskin.provenance import Provenance
from eitskin.simulator.linalg.nested_dissection import Elimination, dissected

Array = NDArray[np.float64]

LAYERS = 4
STIFFNESS = np.array([[7.0, -8.0, 1.0], [-8.0, 16.0, -8.0], [1.0, -8.0, 7.0]]) / 3.0
MASS = np.array([[4.0, 2.0, -1.0], [2.0, 16.0, 2.0], [-1.0, 2.0, 4.0]]) / 30.0
COUPLING = np.array([[2.0, 0.5, 0.5], [0.5, 2.0, 0.5], [0.5, 0.5, 2.0]])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cells", type=int, nargs="*", default=[20, 40])
    print(Provenance.now(0))
    print("\n| unknowns | method | factorisation [s] | factors [MB] | residual |")
    print("|---|---|---|---|---|")
    for cells in parser.parse_args().cells:
        for row in compared(cells):
            print(row, flush=True)


def compared(cells: int) -> list[str]:
    """Rows of the table for one layer."""
    matrix, positions = layer(cells)
    blocks = dissected(positions, [np.arange(cells + 1.0)] * 2)
    order = np.concatenate([block.own for block in blocks])
    right = np.random.default_rng(0).normal(size=len(order))
    ours, ours_s = _timed(lambda: Elimination(matrix, blocks))
    permuted = csc_array(matrix[order][:, order])
    options = {"permc_spec": "NATURAL", "diag_pivot_thresh": 0.0}
    theirs, theirs_s = _timed(lambda: splu(permuted, options={"SymmetricMode": True}, **options))
    ours_mb = ours.stored / 1e6
    theirs_mb = 12 * (theirs.L.nnz + theirs.U.nnz) / 1e6  # a value and a row number each
    residuals = (
        matrix @ ours.solve(right) - right,
        permuted @ theirs.solve(right[order]) - right[order],
    )
    rows = zip(
        ("nested dissection", "SuperLU, same ordering"),
        (ours_s, theirs_s),
        (ours_mb, theirs_mb),
        residuals,
        strict=True,
    )
    size = np.linalg.norm(right)
    return [
        f"| {len(order)} | {name} | {seconds:.2f} | {mb:.0f} | {np.linalg.norm(left) / size:.0e} |"
        for name, seconds, mb, left in rows
    ]


def layer(cells: int) -> tuple[csc_array, Array]:
    """Stiffness matrix of a clamped layer, and (x, y) of its unknowns in cells, (n, 2)."""
    sizes = (cells, cells, LAYERS)
    stiffness, mass = ([_along(n, element) for n in sizes] for element in (STIFFNESS, MASS))
    terms = [
        reduce(kron, [stiffness[k] if k == axis else mass[k] for k in range(3)])
        for axis in range(3)
    ]
    nodes = np.stack(np.meshgrid(*(np.arange(2 * n + 1) for n in sizes), indexing="ij"), axis=-1)
    positions = np.repeat(nodes.reshape(-1, 3), 3, axis=0).astype(np.float64)
    free = np.flatnonzero(positions[:, 2] > 0)
    matrix = csc_array(kron(sum(terms), COUPLING))
    plane: Array = 0.5 * positions[free, :2]
    return csc_array(matrix[free][:, free]), plane


def _along(cells: int, element: Array) -> csc_array:
    """Matrix of quadratic elements in a row, each with the matrix `element` (3, 3)."""
    full = np.zeros((2 * cells + 1, 2 * cells + 1))
    for cell in range(cells):
        full[2 * cell : 2 * cell + 3, 2 * cell : 2 * cell + 3] += element
    return csc_array(full)


def _timed(work: Callable[[], Any]) -> tuple[Any, float]:
    start = time.process_time()
    return work(), time.process_time() - start


if __name__ == "__main__":
    main()
