"""The complete electrode model: closed forms, independent solutions, invariants, twins."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eitskin.errors import ConfigurationError
from eitskin.geometry import Electrode, Rectangle, SensorDesign
from eitskin.geometry.meshing.mesh_design import Grading
from eitskin.simulator import ForwardModel

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


def test_impedance_is_reciprocal_and_its_rows_sum_to_zero(model) -> None:
    """Before any symmetrisation: the electrodes' own potentials, by solving for each current."""
    Z = model.impedance()
    assert Z.sum(axis=0) == pytest.approx(0, abs=1e-10)
    _, U = model.element_potentials()
    U = U - U.mean(axis=0)
    assert pytest.approx(U.T, rel=1e-9, abs=1e-9) == U
    assert pytest.approx(Z, rel=1e-9, abs=1e-9) == U


def test_conductivity_per_cell_equals_the_same_field(model) -> None:
    centres = model.assembly.points.mean(axis=1)
    tensors = np.eye(3) * (1 + 5 * centres[:, 0])[:, None, None]
    by_cell = model.impedance(tensors)
    assert model.impedance(tensors[:, 0, 0]) == pytest.approx(by_cell, rel=1e-12, abs=1e-9)
    smooth = model.impedance(lambda x: 1 + 5 * x[..., 0])
    assert by_cell == pytest.approx(smooth, rel=3e-3, abs=0.7)


@pytest.mark.parametrize(
    ("conductivity", "message"),
    [
        (-1.0, "positive"),
        (float("nan"), "positive"),
        (1j, "real part, positive"),
        ("wet", "numbers"),
        (np.ones(3), "got shape"),
        (lambda x: np.ones(7), "got shape"),  # noqa: ARG005
        (lambda x: np.diag([1.0, 1.0, -1.0]) + 0 * x[..., None], "positive"),
        (lambda x: np.array([[1.0, 0, 0], [0.5, 1, 0], [0, 0, 1]]) + 0 * x[..., None], "symmetric"),
    ],
)
def test_impossible_conductivities_are_refused(model, conductivity, message) -> None:
    with pytest.raises(ConfigurationError, match=message):
        model.impedance(conductivity)


def test_a_contact_impedance_is_that_of_all_electrodes_or_refused(model) -> None:
    one, each = (model.impedance(contact_impedance=z) for z in (2e-3, [2e-3] * 8))
    assert np.array_equal(one, each)
    for z in (0.0, -1e-3, np.nan, np.full(7, 1e-3), "good"):
        with pytest.raises(ConfigurationError, match="contact_impedance"):
            model.impedance(contact_impedance=z)
    for options in ({"resolution": "finest"}, {"solver": "multigrid"}):
        with pytest.raises(ConfigurationError, match=r"coarse.*fine|solver must be"):
            ForwardModel(REFERENCE, **options)


# Random sensors

few = settings(max_examples=8, derandomize=True, deadline=None)


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
