"""The adjoint Jacobian against finite differences of the forward model."""

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import SensorDesign
from eitskin.geometry.design.outline import Disc
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.meshing.mesh_design import Grading
from eitskin.simulator import ForwardModel, Protocol

from contacts import with_contacts

COARSE = Grading(finest=2e-3, coarsest=8e-3, growth=1.0, layers=1)
PROTOCOL = Protocol(((0, 1, 0, 1), (2, 6, 2, 6), (0, 4, 1, 3)), 8)


@pytest.fixture(scope="module")
def model() -> ForwardModel:
    return ForwardModel(SensorDesign.reference(), ((2, 1), COARSE))


@pytest.mark.parametrize("phase", [1.0, 1.0 - 0.6j])
def test_cells_agree_with_central_differences(model, phase) -> None:
    n = len(model.mesh.cells)
    rng = np.random.default_rng(2)
    base, step = phase * (1 + 0.3 * rng.random(n)), 1e-5
    J = model.sensitivity(PROTOCOL, base)
    for _ in range(3):
        direction = rng.standard_normal(n)
        ahead, behind = (
            PROTOCOL.measure(model.impedance(base + s * step * direction)) for s in (1, -1)
        )
        assert J @ direction == pytest.approx((ahead - behind) / (2 * step), rel=1e-6, abs=1e-6)


def test_prisms_larger_than_pixels_leave_none_out() -> None:
    """A disc meshed coarsely: every pixel on it is felt, and pixels share out what cells have."""
    outline = Disc(0.03)
    design = SensorDesign(outline, 0.005, uniform(outline, 8))
    disc = ForwardModel(design, ((2, 1), Grading(3e-3, 0.02, 1.5, layers=1)))
    J = disc.sensitivity(PROTOCOL, pixels=(30, 30))
    assert J.sum(axis=1) == pytest.approx(disc.sensitivity(PROTOCOL).sum(axis=1), rel=1e-4)
    middles = 2e-3 * (np.stack(np.meshgrid(np.arange(30), np.arange(30)), axis=-1) + 0.5)
    inside = outline.contains(middles, margin=1e-3).ravel()
    assert (J[0, inside] < 0.0).all()


def tensor(x):
    """A conductivity [S/m] that differs by place and direction, (..., 3, 3)."""
    found = np.zeros((*x.shape[:-1], 3, 3))
    found[..., 0, 0] = 1.0 + 4.0 * x[..., 0]
    found[..., 1, 1] = 1.5 - 6.0 * x[..., 1]
    found[..., 2, 2] = 0.8
    found[..., 0, 1] = found[..., 1, 0] = 0.3
    return found


@pytest.mark.parametrize("cells", ["hexahedra", "prisms"])
def test_along_a_tensor_agrees_with_central_differences(cells) -> None:
    """A factor on an anisotropic conductivity, of each half, with stretched electrodes."""
    model = ForwardModel(SensorDesign.reference(), ((2, 1), COARSE), (0.075,), cells)

    def area(x, _normal):
        return 1.0 + 2.0 * x[..., 0]

    def measured(share, left):
        def changed(x):
            inside = (x[..., 0] < 0.075) == left
            return tensor(x) * (1.0 + share * inside)[..., None, None]

        return PROTOCOL.measure(model.impedance(changed, area))

    J = model.sensitivity(PROTOCOL, tensor, (1, 2), area, along=tensor)
    for pixel, left in enumerate((True, False)):
        differences = (measured(1e-4, left) - measured(-1e-4, left)) / 2e-4
        assert J[:, pixel] == pytest.approx(differences, rel=4e-5)
    for wrong, message in (({"along": tensor}, "give pixels"), ({"pixels": (0, 3)}, "positive")):
        with pytest.raises(ConfigurationError, match=message):
            model.sensitivity(PROTOCOL, tensor, **wrong)


def test_pixel_rows_run_along_y_and_columns_along_x(model) -> None:
    """Driving the short-side electrode 7 and its neighbour 0 is felt in the lower left corner."""
    J = np.abs(model.sensitivity(Protocol(((7, 0, 7, 0),), 8), pixels=(2, 5))[0]).reshape(2, 5)
    assert np.unravel_index(J.argmax(), J.shape) == (0, 0)


@pytest.mark.parametrize("z", [1e-9, 10.0, 1e-3 - 5e-4j])
def test_contact_sensitivity_agrees_with_central_differences(z) -> None:
    """For every electrode alone, in both forms of the electrode terms, real and complex."""

    def measured(number: int, factor: float):
        contacts = z * np.where(np.arange(8) == number, factor, 1.0)
        return ForwardModel(with_contacts(contacts), ((2, 1), COARSE))

    J = measured(0, 1.0).contact_sensitivity(PROTOCOL)
    assert J.shape == (3, 8)
    step = 1e-4 if abs(z) > 1e-6 else 0.3  # at 1e-9 R depends on z by its tenth digit
    for number in (0, 1, 6):
        ahead, behind = (
            PROTOCOL.measure(measured(number, 1 + s * step).impedance()) for s in (1, -1)
        )
        expected = (ahead - behind) / (2 * step * z)
        assert J[:, number] == pytest.approx(expected, rel=1e-4, abs=1e-4 * abs(J).max())


def test_gradients_above_points_of_the_plane_are_what_potentials_do() -> None:
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
