"""Invariants of every sensor, on random ones."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eitskin.geometry import Electrode, Rectangle, SensorDesign
from eitskin.geometry.meshing.mesh_design import Grading
from eitskin.simulator import ForwardModel, Protocol

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


def model(design) -> ForwardModel:
    size = design.outline.perimeter
    return ForwardModel(design, ((2,), Grading(size / 100, size / 20, 1.0, 1)))


@few
@given(designs(), log_uniform(1e-3, 1e3))
def test_impedance_matrix(design, factor) -> None:
    """Finite, reciprocal, blind to a current that enters everywhere, and never gives power.

    R goes like 1 / sigma where z does too. Turned by a half, with electrodes counted backwards, the
    sensor is the same, though its mesh is numbered the other way.
    """
    Z, outline = model(design).impedance(), design.outline
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
    turned = factor * model(other).impedance()[::-1, ::-1]
    assert pytest.approx(Z, rel=1e-8, abs=1e-9 * scale) == turned


@few
@pytest.mark.filterwarnings("ignore:the conductivity changes:UserWarning")
@given(designs(), st.floats(0, 1), st.floats(0, 1), log_uniform(1e-3, 1e3))
def test_resistance_falls_where_conductivity_rises(design, x, y, factor) -> None:
    """For every pattern of currents: the difference of the matrices is positive semidefinite."""
    centre = np.array([x * design.outline.length, y * design.outline.width])
    size = 0.2 * max(design.outline.length, design.outline.width)
    forward = model(design)

    def raised(points):
        near = np.exp(-((points[..., :2] - centre) ** 2).sum(axis=-1) / size**2)
        return design.conductivity * (1 + factor * near)

    before, after = forward.impedance(), forward.impedance(raised)
    fall = np.linalg.eigvalsh(before - after)
    assert fall[0] >= -1e-10 * np.abs(before).max()
    assert fall[-1] > 0
    pairs = Protocol.pairwise(len(design.electrodes))
    assert np.all(pairs.measure(after) <= pairs.measure(before) * (1 + 1e-9))
