"""Multifrontal factors beside dense solutions and eigenvalues, and the growth of the factors."""

import numpy as np
import pytest
from scipy.sparse import csc_array

from eitskin.errors import ConfigurationError
from eitskin.simulator.linalg import sparse_structure
from eitskin.simulator.linalg.multifrontal import IndefiniteSolver, MultifrontalSolver
from eitskin.simulator.linalg.sparse_structure import (
    Block,
    choose_order,
    dissection,
    level_structure,
    strips,
)


def grid(n, m):
    """Corners of the cells of a grid of n x m cells, and the middles of the cells."""
    nodes = np.arange((n + 1) * (m + 1)).reshape(n + 1, m + 1)
    cells = np.stack([nodes[:-1, :-1], nodes[1:, :-1], nodes[1:, 1:], nodes[:-1, 1:]], axis=-1)
    middles = np.stack(np.meshgrid(np.arange(n), np.arange(m), indexing="ij"), axis=-1)
    return cells.reshape(-1, 4), middles.reshape(-1, 2).astype(float)


def positions(cells):
    """Rows and columns of the lower triangle of a sum of cells."""
    i, j = np.tril_indices(cells.shape[1])
    first, second = cells[:, i].ravel(), cells[:, j].ravel()
    return np.maximum(first, second), np.minimum(first, second)


def assembled(cells, parts):
    """Values at these positions, and the dense matrix."""
    A = np.zeros((cells.max() + 1,) * 2, dtype=parts.dtype)
    np.add.at(A, (cells[:, :, None], cells[:, None]), parts)
    i, j = np.tril_indices(cells.shape[1])
    return parts[:, i, j].ravel(), A


@pytest.mark.parametrize("kind", ["real", "complex"])
@pytest.mark.parametrize(
    ("order", "leaf"), [("strips", 0), ("dissected", 1), ("dissected", 20), ("dissected", 10**6)]
)
def test_solutions_are_those_of_the_dense_matrix(order, leaf, kind, monkeypatch) -> None:
    monkeypatch.setattr(sparse_structure, "_LEAF", leaf)
    rng = np.random.default_rng(7)
    cells, middles = grid(9, 5)
    parts = rng.normal(size=(len(cells), 4, 4))
    parts = parts @ parts.swapaxes(1, 2) + 0.1 * np.eye(4)
    if kind == "complex":
        more = rng.normal(size=parts.shape)
        parts = parts + 1j * (more + more.swapaxes(1, 2))
    (rows, columns), (values, A) = positions(cells), assembled(cells, parts)
    if order == "strips":
        levels = level_structure(cells, np.flatnonzero(middles[:, 0] == 0.0))
    blocks = strips(rows, columns, levels) if order == "strips" else dissection(cells, middles)
    solver = MultifrontalSolver(rows, columns, blocks)
    B = rng.normal(size=(len(A), 3))
    factors, wanted = solver.factorise(values), np.linalg.solve(A, B)
    assert factors.solve(B) == pytest.approx(wanted, rel=1e-9)
    assert solver.congruence(values, B) == pytest.approx(B.T @ wanted, rel=1e-9)
    if kind == "real":
        single = factors.to_single()
        x = B[single.order].astype(np.float32)
        single.solve(x)
        error = np.linalg.norm(x - wanted[single.order]) / np.linalg.norm(wanted)
        assert 1e-10 < error < 1e-4


def indefinite(rng):
    """Symmetric matrix of cells of three unknowns a node, and one unknown coupled to all."""
    nodes, middles = grid(6, 4)
    cells = (3 * nodes[:, :, None] + np.arange(3)).reshape(len(nodes), -1)
    parts = rng.normal(size=(len(cells), 12, 12))
    parts += parts.swapaxes(1, 2)
    A = np.pad(assembled(cells, parts)[1], (0, 1))
    A[-1, :-1] = A[:-1, -1] = rng.normal(size=len(A) - 1)
    blocks = dissection(cells, middles)
    return A, [*blocks, Block(np.array([len(A) - 1]), (len(blocks) - 1,))]


@pytest.mark.parametrize("leaf", [1, 60, 1000])
def test_solutions_and_inertia_are_those_of_an_indefinite_matrix(leaf, monkeypatch) -> None:
    monkeypatch.setattr(sparse_structure, "_LEAF", leaf)
    rng = np.random.default_rng(3)
    A, blocks = indefinite(rng)
    solver, right = IndefiniteSolver(blocks), rng.normal(size=len(A))
    coupled = np.where((A != 0.0) & (rng.random(A.shape) < 0.5), A, 0.0)
    fewer = np.tril(coupled) + np.tril(coupled, -1).T + np.diag(np.diag(A))
    for matrix in (A, A - 0.3 * np.diag(np.diag(A)), fewer):  # the last has another pattern
        found = solver.factorise(csc_array(matrix))
        assert found.negative == np.count_nonzero(np.linalg.eigvalsh(matrix) < 0.0)
        solution = np.linalg.solve(matrix, right)
        assert found.solve(right) == pytest.approx(solution, rel=1e-8, abs=1e-8)


def test_factors_grow_as_n_log_n_in_an_order_that_suits_the_shape(monkeypatch):
    names = []
    for n, m in ((80, 4), (200, 200)):
        cells, middles = grid(n, m)
        names.append(choose_order(None, positions(cells), cells, middles)[0])
    assert names == ["block Cholesky", "nested dissection"]
    with pytest.warns(DeprecationWarning, match="nested dissection"):
        assert choose_order("sparse LU", positions(cells), cells, middles)[0] == names[1]
    with pytest.raises(ConfigurationError, match="parts"):  # two elements that share no unknown
        level_structure(np.array([[0, 1], [2, 3]]), np.array([0]))
    A, blocks = indefinite(np.random.default_rng(6))
    A[5] = A[:, 5] = 0.0
    with pytest.raises(RuntimeError, match="singular"):
        IndefiniteSolver(blocks).factorise(csc_array(A))
    monkeypatch.setattr(sparse_structure, "_LEAF", 20)

    def entries(n):
        cells, middles = grid(n, n)
        rows, columns = positions(cells)
        fronts = MultifrontalSolver(rows, columns, dissection(cells, middles)).fronts
        return sum(front.size * (front.size + front.outer) for front in fronts)

    assert entries(32) / entries(16) < 4.0 * np.log(32) / np.log(16) * 1.2
