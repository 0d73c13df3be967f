"""Nested dissection beside dense solutions and eigenvalues."""

import numpy as np
import pytest
from scipy.sparse import csc_array

from eitskin.simulator.linalg import nested_dissection
from eitskin.simulator.linalg.nested_dissection import Block, by_blocks, dissected

LINES = [np.array([0.0, 0.5, 2.0, 2.5, 3.0, 4.5, 5.0]), np.linspace(0.0, 1.0, 5)]
PER_NODE = 3


def indefinite(rng):
    """Symmetric matrix of unknowns coupled within the cells of a grid, and their positions.

    The last unknown is coupled with all and has no position.
    """
    nx, ny = (len(line) for line in LINES)
    nodes = rng.permutation(nx * ny).reshape(nx, ny)
    positions = np.empty((nx * ny, 2))
    positions[nodes] = np.stack(np.meshgrid(*LINES, indexing="ij"), axis=-1)
    positions = np.vstack([np.repeat(positions, PER_NODE, axis=0), [[np.nan, np.nan]]])
    A = np.zeros((len(positions), len(positions)))
    for i in range(nx - 1):
        for j in range(ny - 1):
            cell = PER_NODE * nodes[i : i + 2, j : j + 2].reshape(-1, 1) + np.arange(PER_NODE)
            part = rng.normal(size=(cell.size, cell.size))
            A[np.ix_(cell.ravel(), cell.ravel())] += part + part.T
    A[-1, :-1] = A[:-1, -1] = rng.normal(size=len(A) - 1)
    return A, positions


@pytest.mark.parametrize("cells", [1, 2, 10])
@pytest.mark.parametrize("strip", [7, 256])
def test_solutions_and_inertia_are_those_of_the_dense_matrix(cells, strip, monkeypatch) -> None:
    monkeypatch.setattr(nested_dissection, "_STRIP", strip)
    rng = np.random.default_rng(3)
    A, positions = indefinite(rng)
    found = by_blocks(dissected(positions, LINES, cells))(csc_array(A))
    assert found.negative == np.count_nonzero(np.linalg.eigvalsh(A) < 0.0)
    right = rng.normal(size=len(A))
    assert found.solve(right) == pytest.approx(np.linalg.solve(A, right), rel=1e-9, abs=1e-9)


def test_unknowns_are_numbered_among_those_of_the_blocks() -> None:
    rng = np.random.default_rng(4)
    A, positions = indefinite(rng)
    free = np.sort(rng.choice(len(A), len(A) - 9, replace=False))
    blocks = [Block(free[b.own], b.within) for b in dissected(positions[free], LINES)]
    right = rng.normal(size=len(free))
    B = A[np.ix_(free, free)]
    assert by_blocks(blocks)(csc_array(B)).solve(right) == pytest.approx(np.linalg.solve(B, right))


def test_a_singular_matrix_is_refused() -> None:
    A, positions = indefinite(np.random.default_rng(6))
    A[5] = A[:, 5] = 0.0
    with pytest.raises(RuntimeError, match="singular"):
        by_blocks(dissected(positions, LINES))(csc_array(A))
