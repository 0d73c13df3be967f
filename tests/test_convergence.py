"""How errors fall with refinement, and that every mesh and element falls to the same values.

The smooth problem is a block between full-end electrodes, seen through a smooth map of the box
onto itself: a full tensor field and contacts that vary from place to place, and yet
R = L / (sigma A) + 2 z / A. Its error is one of energy, so it falls like h^2p for elements of
order p.
"""

import closed_forms
import numpy as np
import pytest

from eitskin.geometry import Electrode, Rectangle, SensorDesign
from eitskin.geometry.deformation import area_ratio, pulled_back
from eitskin.geometry.structured import Grading
from eitskin.simulator import ForwardModel, Protocol

SIZE = np.array([0.04, 0.03, 0.01])
CONTACT = 1e-3
EXACT = closed_forms.block(SIZE[0], SIZE[1] * SIZE[2], 1.0, CONTACT, CONTACT)
BLOCK = SensorDesign(
    Rectangle(*SIZE[:2]),
    SIZE[2],
    tuple(Electrode(x, SIZE[1] / 2, SIZE[1], CONTACT) for x in (0.0, SIZE[0])),
)


def onto_itself(points, amount):
    """Gradient of x_i + amount_i L_i / pi sin(pi x_i / L_i) cos(pi x_j / L_j) cos(pi x_k / L_k)."""
    sin, cos = np.sin(np.pi * points / SIZE), np.cos(np.pi * points / SIZE)
    F = np.zeros((*points.shape, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        F[..., i, i] = 1 + amount[i] * cos[..., i] * cos[..., j] * cos[..., k]
        F[..., i, j] = -amount[i] * SIZE[i] / SIZE[j] * sin[..., i] * sin[..., j] * cos[..., k]
        F[..., i, k] = -amount[i] * SIZE[i] / SIZE[k] * sin[..., i] * cos[..., j] * sin[..., k]
    return F


def error(order, cells, layers, **kind) -> float:
    """Relative error of R with `cells` along x; a single layer is mapped in the plane only."""
    h = SIZE[0] / cells
    model = ForwardModel(BLOCK, (order, Grading(h, h, 1.0, layers)), **kind)
    amount, flat = ((0.2, 0.2, 0.2), 1.0) if layers > 1 else ((0.2, 0.2, 0.0), [1.0, 1.0, 0.0])

    def gradient(x):
        return onto_itself(x * flat, amount)

    Z = model.impedance(
        lambda x: pulled_back(gradient(x)), lambda x, normal: area_ratio(gradient(x), normal)
    )
    return abs(Protocol.pairwise(2).measure(Z)[0] / EXACT - 1)


@pytest.mark.parametrize(
    ("order", "cells"), [((1, 1), (8, 16)), ((2,), (8, 16)), ((3,), (4, 8)), ((4,), (4, 8))]
)
def test_rate_of_one_layer_of_hexahedra(order, cells) -> None:
    errors = [error(order, n, layers=1) for n in cells]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2 * order[0], abs=0.1)


@pytest.mark.parametrize(("order", "cells"), [((1, 1), (8, 16)), ((2, 2, 2), (4, 8))])
def test_rate_of_hexahedra(order, cells) -> None:
    errors = [error(order, n, layers=n // 2) for n in cells]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2 * order[0], abs=0.1)
