"""Products in single precision in which equal rows or columns are equal to the last bit.

Numbers of a scene must not depend on its neighbours in an array, nor on its place there. But
near the ends of an array some processors add up the terms of a product in another order (OpenBLAS
on Haswell and Zen). Where they do is found by products of equal rows and columns, in one thread:
more would divide an array, and each part has ends.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from eitskin.threads import one_thread

Single = NDArray[np.float32]

_SHAPES = ((255, 191), (41, 88), (300, 20), (7, 250), (1, 300), (64, 64), (3000, 30))
_BLOCKS = 16, 8, 4, 2  # rows, the fastest first
_MARGINS = 0, 8, 16, 32


@cache
@one_thread()
def block_rows() -> int:
    """Number of rows of a product, so that equal ones are alike wherever in it they are."""

    def are_alike(rows: int) -> bool:
        for outer, inner in _SHAPES:
            product = _equal_columns(inner, rows).T @ _matrix(inner, outer)
            if (product != product[0]).any():
                return False
        return True

    return next((rows for rows in _BLOCKS if are_alike(rows)), 1)


@cache
@one_thread()
def column_margin(columns: int) -> int | None:
    """Columns to leave empty on either side, so that `columns` are alike; None if nothing helps."""

    def are_alike(margin: int) -> bool:
        used = slice(margin, margin + columns)
        for outer, inner in _SHAPES:
            matrix = _matrix(outer, inner)
            for factor in (matrix, matrix.T):
                product = (factor @ _equal_columns(factor.shape[1], columns + 2 * margin))[:, used]
                if (product != product[:, :1]).any():
                    return False
        return True

    return next((margin for margin in _MARGINS if are_alike(margin)), None)


def _matrix(rows: int, columns: int) -> Single:
    return np.random.default_rng(0).standard_normal((rows, columns), dtype=np.float32)


def _equal_columns(rows: int, columns: int) -> Single:
    """Equal columns, row by row in memory."""
    return np.repeat(_matrix(rows, 1), columns, axis=1)
