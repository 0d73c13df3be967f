"""Multifrontal Cholesky beside dense solutions, and the growth of its factors."""

import numpy as np
import pytest

from eitskin.simulator.linalg import multifrontal_cholesky
from eitskin.simulator.linalg.multifrontal_cholesky import MultifrontalCholesky


def grid(n):
    """Corners of the cells of a square grid of n x n cells, and the middles of the cells."""
    nodes = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    cells = np.stack([nodes[:-1, :-1], nodes[1:, :-1], nodes[1:, 1:], nodes[:-1, 1:]], axis=-1)
    middles = np.stack(np.meshgrid(np.arange(n), np.arange(n), indexing="ij"), axis=-1)
    return cells.reshape(-1, 4), middles.reshape(-1, 2).astype(float)


def prepared(n):
    """Solver of random symmetric cells on a grid, the values, and the dense matrix."""
    rng = np.random.default_rng(n)
    cells, middles = grid(n)
    parts = rng.normal(size=(len(cells), 4, 4))
    parts = parts @ parts.swapaxes(1, 2) + 0.1 * np.eye(4)
    A = np.zeros((cells.max() + 1,) * 2)
    np.add.at(A, (cells[:, :, None], cells[:, None]), parts)
    i, j = np.tril_indices(4)
    first, second = cells[:, i].ravel(), cells[:, j].ravel()
    rows, columns = np.maximum(first, second), np.minimum(first, second)
    return MultifrontalCholesky(rows, columns, cells, middles), parts[:, i, j].ravel(), A


@pytest.mark.parametrize("leaf", [1, 12, 1000])
def test_solutions_are_those_of_the_dense_matrix(leaf, monkeypatch) -> None:
    monkeypatch.setattr(multifrontal_cholesky, "_LEAF", leaf)
    solver, values, A = prepared(7)
    B = np.random.default_rng(1).normal(size=(len(A), 3))
    factors, wanted = solver.factorise(values), np.linalg.solve(A, B)
    assert factors.solve(B) == pytest.approx(wanted, rel=1e-9)
    assert np.linalg.norm(factors.rounded().solve(B) - wanted) < 1e-4 * np.linalg.norm(wanted)
    assert solver.congruence(values, B) == pytest.approx(B.T @ wanted, rel=1e-9)


def test_each_unknown_is_eliminated_once() -> None:
    solver, *_ = prepared(9)
    ends = [(front.own.start, front.own.stop) for front in solver.fronts]
    assert [first for first, _ in ends] == [0, *(last for _, last in ends[:-1])]
    assert ends[-1][1] == 100
    assert all((front.border >= front.own.stop).all() for front in solver.fronts)


def test_factors_grow_as_n_log_n() -> None:
    def entries(n):
        fronts = prepared(n)[0].fronts
        own = np.array([front.own.stop - front.own.start for front in fronts])
        return int((own * (own + [len(front.border) for front in fronts])).sum())

    assert entries(32) / entries(16) < 4.0 * np.log(32) / np.log(16) * 1.2
