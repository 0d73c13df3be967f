"""Gradients above many places of a column at once, against one function and point at a time."""

import numpy as np
import pytest

from eitskin.geometry import SensorDesign
from eitskin.geometry.meshing.mesh_design import Grading
from eitskin.simulator import ForwardModel
from eitskin.simulator.electrical.elements import ExtrudedElement

HEIGHTS = (0.0, 0.002, 0.005)


@pytest.mark.parametrize("condensed", [True, False])
@pytest.mark.parametrize("base", ["quadrilateral", "triangle"])
@pytest.mark.parametrize("order", [(1,), (2, 1), (3, 2, 1)])
def test_sums_are_those_of_all_functions_at_every_point(base, order, condensed) -> None:
    element = ExtrudedElement(base, order, HEIGHTS, condensed)
    rng = np.random.default_rng(1)
    X, z = rng.uniform(0.0, 0.5, size=(2, 4, 5)), np.array([0.0003, 0.0019, 0.0021, 0.0048])
    coefficients = rng.normal(size=(4, len(element.functions), 2))
    everywhere = np.empty((3, 4, 5, 4))
    everywhere[:2], everywhere[2] = X[..., None], z
    plain = np.einsum("fanpq,nfk->napqk", element.gradients(everywhere), coefficients)
    found = element.column_gradients(coefficients, X, z)
    np.testing.assert_allclose(found, plain, rtol=1e-12, atol=1e-10)


def test_on_the_body_they_are_what_potentials_do() -> None:
    """Over steps of a micrometre, along each axis."""
    model = ForwardModel(
        SensorDesign.reference(),
        ((2, 1), Grading(finest=2e-3, coarsest=8e-3, growth=1.0, layers=2)),
    )
    space, rng = model.assembly.space, np.random.default_rng(2)
    inside = rng.normal(size=(len(space.origins), len(space.element.functions), 3))
    elements, step = np.array([0, 17, 40]), 1e-6
    corners = space.origins[elements, None]
    plane = corners[..., :2] + rng.uniform(0.2e-3, 0.8e-3, size=(3, 2, 2))
    heights = np.array([0.001, 0.004])
    found = space.column_gradients(inside, elements, plane, heights)

    def values(moved):
        points = np.empty((3, 2, 2, 3))
        points[..., :2], points[..., 2] = plane[:, :, None], heights
        shape = space.element.values(space.reference(elements, points + moved))
        return np.einsum("fnpq,nfk->npqk", shape, inside[elements])

    for axis, way in enumerate(np.eye(3)):
        slope = (values(step * way) - values(-step * way)) / (2 * step)
        np.testing.assert_allclose(found[:, axis], slope, rtol=1e-6, atol=1e-4)
