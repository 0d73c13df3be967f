"""Inclusions with faces of the mesh at their rims, beside the closed form of a disc in a disc."""

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Disc, Inclusion, Polygon, Rectangle, SensorDesign
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.meshing.grading import Grading
from eitskin.protocol import Protocol
from eitskin.simulator import ForwardModel

RADIUS, HEIGHT, COUNT = 0.05, 0.005, 8
ROUND = SensorDesign(
    Disc(RADIUS),
    HEIGHT,
    uniform(Disc(RADIUS), COUNT, width=0.0004, contact_impedance=1e-7),
)
PROTOCOL = Protocol.adjacent(COUNT)
COARSE = ((2, 2, 2), Grading(0.0004, 0.008, 0.5))


def closed_form(part: float, contrast: float) -> np.ndarray:
    """Measurements of a concentric disc of `part` of the radius, by a Fourier series.

    Source: Isaacson, IEEE Trans. Med. Imaging 5 (1986) 91-95.
    """
    mu, n = (1.0 - contrast) / (1.0 + contrast), np.arange(1, 2001)
    gain = (1.0 + mu * part ** (2 * n)) / (1.0 - mu * part ** (2 * n)) / (np.pi * HEIGHT * n)
    angles = 2.0 * np.pi * np.arange(COUNT) / COUNT
    potential = (np.cos(np.outer(angles, n)) * gain).sum(axis=1)
    a, b, c, e = np.array(PROTOCOL.table).T
    return potential[c - a] - potential[c - b] - potential[e - a] + potential[e - b]


@pytest.mark.parametrize("contrast", [2.0, 100.0])
def test_a_disc_in_a_disc_has_the_signal_of_the_closed_form(contrast) -> None:
    found = []
    for inside in (contrast, 1.0):
        disc = Inclusion.cylinder(RADIUS, RADIUS, 0.5 * RADIUS, inside)
        model = ForwardModel(ROUND, COARSE, inclusions=[disc])
        found.append(PROTOCOL.measure(model.impedance()).real)
    expected = closed_form(0.5, contrast) - closed_form(0.5, 1.0)
    assert np.abs(found[0] - found[1] - expected).max() < 0.01 * np.abs(expected).max()


def test_no_cell_crosses_the_rim_of_an_inclusion() -> None:
    outline = Polygon(((0, 0), (0.1, 0), (0.1, 0.03), (0.03, 0.03), (0.03, 0.1), (0, 0.1)))
    design = SensorDesign(outline, HEIGHT, uniform(outline, 8))
    triangle = Polygon(((0, 0), (0.012, 0), (0.006, 0.01)))
    parts = [
        Inclusion.box(0.06, 0.015, 0.04, 0.01, 2.0),
        Inclusion(triangle, 0.015, 0.06, 3.0),
        Inclusion.cylinder(0.06, 0.0155, 0.003, 4.0 + 1.0j),
    ]
    model = ForwardModel(design, ((1, 1, 1), Grading(0.002, 0.01, 0.5)), inclusions=parts)
    corners = model.mesh.points[model.mesh.cells][..., :2]
    for part in parts:
        depth = part.mesh_outline.nearest(corners - part.origin)[1]
        assert ((depth > -1e-9).all(axis=1) | (depth < 1e-9).all(axis=1)).all()
    values = model._conductivity(None)[:, 0, 0]
    assert set(values.tolist()) == {1.0, 2.0, 3.0, 4.0 + 1.0j}


@pytest.mark.parametrize(
    ("inclusions", "message"),
    [
        ([Inclusion.cylinder(0.02, 0.05, 0.03, 2.0)], "0 must lie within"),
        ([Inclusion.box(0.05, 0.05, 0.04, 0.02, 2.0)] * 2, "0 and 1 must not cross"),
    ],
)
def test_rims_that_touch_are_refused(inclusions, message) -> None:
    with pytest.raises(ConfigurationError, match=message):
        ForwardModel(ROUND, COARSE, inclusions=inclusions)


def test_hexahedra_have_no_faces_at_inclusions() -> None:
    with pytest.raises(ConfigurationError, match="prisms"):
        ForwardModel(
            SensorDesign(Rectangle(0.1, 0.05), HEIGHT, uniform(Rectangle(0.1, 0.05), 8)),
            cells="hexahedra",
            inclusions=[Inclusion.box(0.05, 0.025, 0.01, 0.01, 2.0)],
        )
    with pytest.raises(ConfigurationError, match="positive real part"):
        Inclusion.box(0.05, 0.025, 0.01, 0.01, -2.0)


def test_a_field_that_jumps_within_cells_says_so() -> None:
    model = ForwardModel(ROUND, COARSE)
    with pytest.warns(UserWarning, match="Inclusion"):
        model.impedance(lambda x: np.where(x[..., 0] > 0.043, 2.0, 1.0))
