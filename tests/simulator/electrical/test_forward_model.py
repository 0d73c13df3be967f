"""The forward model: laws that impedances obey, and their sensitivities."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eitskin.errors import ConfigurationError
from eitskin.geometry import Disc, Electrode, Rectangle, SensorDesign
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.meshing.mesh_design import Grading
from eitskin.simulator import ForwardModel, Protocol
from eitskin.simulator.electrical.elements import ExtrudedElement

from contacts import with_contacts

REFERENCE = SensorDesign.reference()
COARSE = Grading(finest=2.5e-3, coarsest=1e-2, growth=1.0, layers=1)


@pytest.fixture(scope="module")
def model() -> ForwardModel:
    return ForwardModel(REFERENCE, "fast")


@pytest.mark.parametrize(("order", "z"), [((2, 2), 1e-9), ((3, 2, 1), 1e3)])
def test_potentials_count_from_the_mean_of_the_electrodes(order, z) -> None:
    """Half an ampere from end to end: u = (L / 2 - x) / (2 sigma A), whatever is grounded."""
    ends = (Electrode(0.0, 0.02, 0.04, z), Electrode(0.1, 0.02, 0.04, 2 * z))
    block = SensorDesign(Rectangle(0.1, 0.04), 0.005, ends, conductivity=0.5)
    model = ForwardModel(block, (order, COARSE))
    area = 0.04 * 0.005
    # The far contact drops as much again as the near one, half of which is on either side of zero.
    expected = (0.05 - model.mesh.points[:, 0]) / (2 * 0.5 * area) + 0.5 * z / (2 * area)
    reach = np.abs(expected).max()
    assert model.potentials()[:, 0] == pytest.approx(expected, abs=1e-9 * reach)
    assert model.potentials()[:, 1] == pytest.approx(-expected, abs=1e-9 * reach)


@pytest.mark.slow
def test_impedance_is_reciprocal_its_rows_sum_to_zero_and_cells_equal_the_field(model):
    """Before any symmetrisation: the electrodes' own potentials, by solving for each current."""
    Z = model.impedance()
    assert Z.sum(axis=0) == pytest.approx(0, abs=1e-10)
    _, U = model.element_potentials()
    U = U - U.mean(axis=0)
    assert pytest.approx(U.T, rel=1e-9, abs=1e-9) == U
    assert pytest.approx(Z, rel=1e-9, abs=1e-9) == U
    centres = model.assembly.points.mean(axis=1)
    tensors = np.eye(3) * (1 + 5 * centres[:, 0])[:, None, None]
    by_cell = model.impedance(tensors)
    assert model.impedance(tensors[:, 0, 0]) == pytest.approx(by_cell, rel=1e-12, abs=1e-9)
    smooth = model.impedance(lambda x: 1 + 5 * x[..., 0])
    assert by_cell == pytest.approx(smooth, rel=3e-3, abs=0.7)
    one, each = (model.impedance(contact_impedance=z) for z in (2e-3, [2e-3] * 8))
    assert np.array_equal(one, each)
    for z in (0.0, -1e-3, np.nan, np.full(7, 1e-3), "good"):
        with pytest.raises(ConfigurationError, match="contact_impedance"):
            model.impedance(contact_impedance=z)
    for options in ({"resolution": "finest"}, {"solver": "multigrid"}):
        with pytest.raises(ConfigurationError, match=r"coarse.*fine|solver must be"):
            ForwardModel(REFERENCE, **options)


# Random sensors

few = settings(max_examples=8, derandomize=True)


def log_uniform(low, high):
    return st.floats(np.log10(low), np.log10(high)).map(lambda power: float(10**power))


@st.composite
def designs(draw):
    """Rectangles with two to six electrodes anywhere around the side, any materials."""
    extent = draw(log_uniform(1e-2, 1.0))
    outline = Rectangle(extent, extent * draw(st.floats(0.2, 5.0)))
    thickness = extent * draw(st.floats(0.01, 0.3))
    count = draw(st.integers(2, 6))
    shares = st.floats(0.1, 1.0)
    lengths = np.array(draw(st.lists(shares, min_size=2 * count, max_size=2 * count)))
    ends = np.cumsum(lengths) / lengths.sum() * outline.perimeter
    starts, ends = ends[0::2], ends[1::2]
    electrodes = tuple(
        Electrode(
            *outline.rim_points((a + b) / 2).tolist(), float(b - a), draw(log_uniform(1e-7, 1e1))
        )
        for a, b in zip(starts, ends, strict=True)
    )
    conductivity = draw(log_uniform(1e-3, 1e2))
    return SensorDesign(
        outline, thickness, electrodes, conductivity, encapsulated_thickness=2 * thickness
    )


def coarse_model(design) -> ForwardModel:
    size = design.outline.perimeter
    return ForwardModel(design, ((2,), Grading(size / 100, size / 20, 1.0, 1)))


@pytest.mark.slow
@few
@given(designs(), log_uniform(1e-3, 1e3))
def test_impedance_matrix(design, factor) -> None:
    """Finite, reciprocal, blind to a current that enters everywhere, and never gives power.

    R goes like 1 / sigma where z does too. Turned by a half, with electrodes counted backwards, the
    sensor is the same, though its mesh is numbered the other way.
    """
    Z, outline = coarse_model(design).impedance(), design.outline
    assert np.isfinite(Z).all()
    scale = np.abs(Z).max()
    assert pytest.approx(Z.T, rel=1e-9, abs=1e-12 * scale) == Z
    assert Z.sum(axis=0) == pytest.approx(0, abs=1e-10 * scale)
    values = np.linalg.eigvalsh(Z)
    assert values[0] == pytest.approx(0, abs=1e-10 * scale)
    assert values[1] > 0
    electrodes = tuple(
        dataclasses.replace(
            e,
            x=outline.length - e.x,
            y=outline.width - e.y,
            contact_impedance=e.contact_impedance / factor,
        )
        for e in reversed(design.electrodes)
    )
    other = dataclasses.replace(
        design, conductivity=design.conductivity * factor, electrodes=electrodes
    )
    turned = factor * coarse_model(other).impedance()[::-1, ::-1]
    assert pytest.approx(Z, rel=1e-8, abs=1e-9 * scale) == turned


# Sensitivities


CELLS_OF_PIXELS = Grading(finest=2e-3, coarsest=8e-3, growth=1.0, layers=1)
PROTOCOL = Protocol(((0, 1, 0, 1), (2, 6, 2, 6), (0, 4, 1, 3)), 8)


@pytest.fixture(scope="module")
def pixel_model() -> ForwardModel:
    return ForwardModel(SensorDesign.reference(), ((2, 1), CELLS_OF_PIXELS))


@pytest.mark.parametrize("phase", [1.0, 1.0 - 0.6j])
def test_cells_agree_with_central_differences(pixel_model, phase) -> None:
    n = len(pixel_model.mesh.cells)
    rng = np.random.default_rng(2)
    base, step = phase * (1 + 0.3 * rng.random(n)), 1e-5
    J = pixel_model.sensitivity(PROTOCOL, base)
    for _ in range(3):
        direction = rng.standard_normal(n)
        ahead, behind = (
            PROTOCOL.measure(pixel_model.impedance(base + s * step * direction)) for s in (1, -1)
        )
        assert J @ direction == pytest.approx((ahead - behind) / (2 * step), rel=1e-6, abs=1e-6)


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
    pixel_model = ForwardModel(SensorDesign.reference(), ((2, 1), CELLS_OF_PIXELS), (0.075,), cells)

    def area(x, _normal):
        return 1.0 + 2.0 * x[..., 0]

    def measured(share, left):
        def changed(x):
            inside = (x[..., 0] < 0.075) == left
            return tensor(x) * (1.0 + share * inside)[..., None, None]

        return PROTOCOL.measure(pixel_model.impedance(changed, area))

    J = pixel_model.sensitivity(PROTOCOL, tensor, (1, 2), area, along=tensor)
    for pixel, left in enumerate((True, False)):
        differences = (measured(1e-4, left) - measured(-1e-4, left)) / 2e-4
        assert J[:, pixel] == pytest.approx(differences, rel=4e-5)
    for wrong, message in (({"along": tensor}, "give pixels"), ({"pixels": (0, 3)}, "positive")):
        with pytest.raises(ConfigurationError, match=message):
            pixel_model.sensitivity(PROTOCOL, tensor, **wrong)


def test_pixels_run_along_y_and_x_and_gradients_are_what_potentials_do(pixel_model):
    """Driving the short-side electrode 7 and its neighbour 0 is felt in the lower left corner."""
    J = np.abs(pixel_model.sensitivity(Protocol(((7, 0, 7, 0),), 8), pixels=(2, 5))[0]).reshape(
        2, 5
    )
    assert np.unravel_index(J.argmax(), J.shape) == (0, 0)
    # A disc meshed coarsely: every pixel on it is felt, and pixels share out what cells have.
    outline = Disc(0.03)
    design = SensorDesign(outline, 0.005, uniform(outline, 8))
    disc = ForwardModel(design, ((2, 1), Grading(3e-3, 0.02, 1.5, layers=1)))
    J = disc.sensitivity(PROTOCOL, pixels=(30, 30))
    assert J.sum(axis=1) == pytest.approx(disc.sensitivity(PROTOCOL).sum(axis=1), rel=1e-4)
    middles = 2e-3 * (np.stack(np.meshgrid(np.arange(30), np.arange(30)), axis=-1) + 0.5)
    inside = outline.contains(middles, margin=1e-3).ravel()
    assert (J[0, inside] < 0.0).all()
    # Over steps of a micrometre, along each axis.
    pixel_model = ForwardModel(
        SensorDesign.reference(),
        ((2, 1), Grading(finest=2e-3, coarsest=8e-3, growth=1.0, layers=2)),
    )
    space, rng = pixel_model.assembly.space, np.random.default_rng(2)
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


@pytest.mark.slow
@pytest.mark.parametrize("z", [1e-9, 10.0, 1e-3 - 5e-4j])
def test_contact_sensitivity_agrees_with_central_differences(z) -> None:
    """For every electrode alone, in both forms of the electrode terms, real and complex."""

    def measured(number: int, factor: float):
        contacts = z * np.where(np.arange(8) == number, factor, 1.0)
        return ForwardModel(with_contacts(contacts), ((2, 1), CELLS_OF_PIXELS))

    J = measured(0, 1.0).contact_sensitivity(PROTOCOL)
    assert J.shape == (3, 8)
    step = 1e-4 if abs(z) > 1e-6 else 0.3  # at 1e-9 R depends on z by its tenth digit
    for number in (0, 1, 6):
        ahead, behind = (
            PROTOCOL.measure(measured(number, 1 + s * step).impedance()) for s in (1, -1)
        )
        expected = (ahead - behind) / (2 * step * z)
        assert J[:, number] == pytest.approx(expected, rel=1e-4, abs=1e-4 * abs(J).max())


def test_a_model_that_is_too_large_names_the_resolution_that_fits(monkeypatch) -> None:
    monkeypatch.setattr("eitskin.simulator.electrical.function_space.MAX_MEMORY", 5e7)
    with pytest.raises(ConfigurationError, match="'fast' fits"):
        ForwardModel(SensorDesign.reference(), "standard")


@pytest.mark.parametrize("base", ["quadrilateral", "triangle"])
def test_an_indicator_is_one_between_its_heights_and_falls_to_zero_at_the_next(base):
    """It lifts the potential of an electrode that covers a part of the height."""
    element = ExtrudedElement(base, (2, 2, 1), (0.0, 0.001, 0.002, 0.003, 0.005), condensed=False)
    across, up = np.full(9, 0.3), np.linspace(0.0, 0.005, 9)
    values = element.values(np.stack([across, across, up]))
    for low, high in ((0.001, 0.002), (0.0, 0.001), (0.003, 0.005), (0.0, 0.005)):
        wanted = np.isclose(np.array(element.heights), np.clip(element.heights, low, high))
        found = element.indicator(low, high) @ values
        expected = np.interp(up, element.heights, wanted.astype(float))
        assert found == pytest.approx(expected, abs=1e-12)
