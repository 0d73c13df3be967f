"""LAPACK called directly gives the results of numpy.linalg."""

import numpy as np
import pytest

from eitskin.training.joint import lapack


@pytest.fixture
def covariance():
    draws = np.random.default_rng(0).standard_normal((7, 40)) * [[1e-3]] * 7
    return draws @ draws.T


def test_whitening_is_the_inverse_of_the_cholesky_factor(covariance):
    said = lapack.whitening(covariance)
    expected = np.linalg.inv(np.linalg.cholesky(covariance))
    np.testing.assert_allclose(said, expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_array_equal(said, np.tril(said))


def test_solved_and_inverse(covariance):
    right = np.random.default_rng(1).standard_normal((7, 3))
    for b in (right, right[:, 0]):
        np.testing.assert_allclose(lapack.solve(covariance, b), np.linalg.solve(covariance, b))
    np.testing.assert_allclose(lapack.inverse(covariance), np.linalg.inv(covariance), rtol=1e-8)


def test_what_is_given_stays_as_it_was(covariance):
    """Inputs stay unchanged, also views whose rows are not contiguous."""
    before, part = covariance.copy(), covariance[1:, 1:]
    for matrix in (covariance, part):
        lapack.whitening(matrix)
        lapack.inverse(matrix)
        lapack.solve(matrix, np.ones(len(matrix)))
        lapack.orthonormal(matrix)
    np.testing.assert_array_equal(covariance, before)
    np.testing.assert_allclose(lapack.inverse(part), np.linalg.inv(part), rtol=1e-8)


def test_what_is_no_covariance_is_refused(covariance):
    with pytest.raises(np.linalg.LinAlgError, match="minor 3"):
        lapack.whitening(np.diag([1.0, 1.0, -1.0]))
    with pytest.raises(np.linalg.LinAlgError, match="minor 1"):
        lapack.solve(-covariance, np.ones(7))


@pytest.mark.parametrize("shape", [(9, 4), (4, 4), (3, 5)])
def test_orthonormal_spans_the_columns(shape):
    columns = np.random.default_rng(2).standard_normal(shape)
    basis, (expected, _) = lapack.orthonormal(columns), np.linalg.qr(columns)
    assert basis.shape == expected.shape
    np.testing.assert_allclose(basis.T @ basis, np.eye(min(shape)), atol=1e-12)
    np.testing.assert_allclose(basis @ basis.T, expected @ expected.T, atol=1e-12)
