"""The electrical rows of the verification table, each against a closed form of its own."""

import numpy as np
import pytest

from eitskin.benchmarks.stability.closed_forms import block, shunt_pair
from eitskin.geometry import Electrode, Rectangle, SensorDesign
from eitskin.geometry.deformation.kinematics import area_ratio
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import ForwardModel, Protocol

import closed_forms
from alternatives import pulled_back

THICKNESS = 0.005
COARSE = Grading(finest=2.5e-3, coarsest=1e-2, growth=1.0, layers=1)
EVEN = Grading(finest=5e-3, coarsest=5e-3, growth=1.0, layers=1)
SHARP = Grading(finest=1e-6, coarsest=2e-2, growth=1.5, layers=1)


def two_electrodes(outline, *electrodes, conductivity=1.0):
    return SensorDesign(outline, THICKNESS, electrodes, conductivity)


def strip(*z, conductivity=1.0):
    """100 x 40 mm with an electrode over each whole end."""
    ends = (Electrode(0.0, 0.02, 0.04, z[0]), Electrode(0.1, 0.02, 0.04, z[-1]))
    return two_electrodes(Rectangle(0.1, 0.04), *ends, conductivity=conductivity)


def pair(Z):
    return Protocol.pairwise(2).measure(Z)[0]


def resistance(model, *scene):
    return pair(model.impedance(*scene))


# Block between full-end electrodes


@pytest.mark.parametrize("z", [(1e-3, 1e-3), (1e-9, 1e3), (1e-3 - 4e-3j, 1e-6 + 2e-4j)])
@pytest.mark.parametrize("order", [(1,), (3, 2, 1), (5, 4)])
def test_block_between_any_contacts(z, order) -> None:
    R = resistance(ForwardModel(strip(*z, conductivity=0.5), (order, COARSE)))
    exact = block(0.1, 0.04 * THICKNESS, 0.5, *z)
    assert R == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("z", [1e-9, 1e-3, 1e3])
def test_body_of_a_block_keeps_its_digits_beside_any_contact(z) -> None:
    """R - 2 z / A, a millionth of R at z = 1e3, is still L / (sigma A)."""
    R = resistance(ForwardModel(strip(z), ((2,), COARSE)))
    area = 0.04 * THICKNESS
    assert R - 2 * z / area == pytest.approx(block(0.1, area, 1.0), rel=1e-6)


# Two shunt electrodes on a rectangle

PAIRS = {
    "short-side mids": (((0.0, 0.03), (0.15, 0.03)), 3.796273),
    "long-side mids": (((0.075, 0.0), (0.075, 0.06)), 2.178901),
    "one side": (((0.0225, 0.0), (0.075, 0.0)), 2.593986),
    "neighbours round a corner": (((0.1275, 0.0), (0.15, 0.03)), None),
}


def edges(place):
    """Ends of a 5 mm electrode on the rim of 150 x 60 mm, in turn counter-clockwise."""
    along = {0.0: (-1, 0), 0.06: (1, 0)}.get(place[1], (0, 1 if place[0] == 0.0 else -1))
    half = 0.0025 * np.array(along)
    return tuple(place + half), tuple(place - half)


@pytest.mark.parametrize("name", PAIRS)
def test_two_shunt_electrodes_on_a_rectangle(name) -> None:
    places, table = PAIRS[name]
    exact = shunt_pair(0.15, 0.06, [*edges(places[0]), *edges(places[1])])
    if table is not None:
        assert exact == pytest.approx(table, abs=6e-7)
    design = two_electrodes(
        Rectangle(0.15, 0.06), *(Electrode(*place, 0.005, 1e-9) for place in places)
    )
    R = resistance(ForwardModel(design, ((4,), SHARP)))
    assert R * THICKNESS == pytest.approx(exact, rel=5e-5)


# Annular sectors and discs: a rectangle seen through the polar map


class Polar:
    """Maps x to the radius, `inner` to `outer`, and y to the angle, 0 to `angle`."""

    def __init__(self, outline, angle, inner, outer):
        self.inner = inner
        self.rates = ((outer - inner) / outline.length, angle / outline.width)

    def gradient(self, x):
        along, turning = self.rates
        radius, turn = self.inner + along * x[..., 0], turning * x[..., 1]
        cos, sin = np.cos(turn), np.sin(turn)
        F = np.zeros((*x.shape, 3))
        F[..., 0, 0], F[..., 1, 0] = along * cos, along * sin
        F[..., 0, 1], F[..., 1, 1] = -turning * radius * sin, turning * radius * cos
        F[..., 2, 2] = 1.0
        return F

    def impedance(
        self, design, grading=EVEN, breaks=(), conductivity=lambda x: np.ones(x.shape[:-1])
    ):
        model = ForwardModel(design, ((4,), grading), breaks)
        return model.impedance(
            lambda x: conductivity(x)[..., None, None] * pulled_back(self.gradient(x)),
            lambda x, normal: area_ratio(self.gradient(x), normal),
        )


@pytest.mark.parametrize("z", [1e-9, 1e-3, 1.0])
def test_sector_between_its_curved_faces(z) -> None:
    design = strip(z)
    Z = Polar(design.outline, 2.0, 0.02, 0.05).impedance(design)
    exact = closed_forms.sector_between_arcs(2.0, 0.02, 0.05, z)
    assert pair(Z) * THICKNESS == pytest.approx(exact, rel=1e-6)


@pytest.mark.parametrize("ratio", [1e6, 0.5 + 2j])
def test_concentric_disc(ratio) -> None:
    """Half a disc, as currents cos(n phi) are even; they leave evenly from very bad contacts."""
    count, share, z, radius = 8, 0.5, 1e3, 0.6
    outline = Rectangle(0.1, 0.08)
    pitch = outline.width / count
    places = pitch * (np.arange(count) + 0.5)
    electrodes = (Electrode(outline.length, float(y), share * pitch, z) for y in places)
    design = SensorDesign(outline, THICKNESS, tuple(electrodes))
    polar, interface = Polar(outline, np.pi, 1e-3, 1.0), outline.length * (radius - 1e-3) / 0.999
    Z = polar.impedance(
        design,
        Grading(finest=1e-4, coarsest=1e-2, growth=1.0, layers=1),
        (interface,),
        lambda x: np.where(x[..., 0] < interface, ratio, 1.0),
    )
    width = share * np.pi / count
    for n in (1, 2, 5):
        pattern = np.cos(n * np.pi * (np.arange(count) + 0.5) / count)
        measured = pattern @ Z @ pattern / (pattern @ pattern) * THICKNESS - z / width
        exact = closed_forms.ring_of_gap_electrodes(
            n, 2 * count, width, lambda m: closed_forms.concentric_disc(m, ratio, radius)
        )
        assert measured == pytest.approx(exact, rel=1e-4)
