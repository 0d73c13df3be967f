"""Equal rows and columns of products are equal to the last bit, wherever they stand."""

import numpy as np
import pytest

from eitskin.simulator.linalg.alike_products import block_rows, column_margin
from eitskin.threads import one_thread


@pytest.mark.parametrize("columns", [16, 48, 64, 80])
def test_what_stands_beside_a_row_or_column_does_not_change_it(columns):
    rng, rows, margin = np.random.default_rng(3), block_rows(), column_margin(columns) or 0
    used = slice(margin, margin + columns)
    with one_thread():
        for outer, inner in rng.integers(1, 320, (20, 2)):
            matrix = rng.standard_normal((outer, inner), dtype=np.float32)
            beside = rng.standard_normal((inner, columns + 2 * margin), dtype=np.float32)
            order = rng.permutation(columns)
            moved = beside.copy()
            moved[:, used] = beside[:, used][:, order]
            product, again = (matrix @ each for each in (beside, moved))
            if column_margin(columns) is not None:
                assert np.array_equal(product[:, used][:, order], again[:, used])
            block = rng.standard_normal((rows, outer), dtype=np.float32)
            order = rng.permutation(rows)
            assert np.array_equal((block @ matrix)[order], block[order] @ matrix)
