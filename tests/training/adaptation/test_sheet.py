"""Symmetry of a ring of electrodes: channels alike, copies of presses, signed gains."""

import dataclasses

import numpy as np
import pytest

from eitskin.geometry import SensorDesign
from eitskin.geometry.design.electrode import Electrode
from eitskin.geometry.design.outline import Disc
from eitskin.simulator import Protocol
from eitskin.training.adaptation.channel_maps import PlaceKernel, Presses
from eitskin.training.adaptation.sheet import Sectors, design_span

RADIUS, N = 0.05, 6
ANGLES = 2 * np.pi * np.arange(N) / N
PROTOCOL = Protocol.from_rows(
    [(d, (d + 3) % N, (s + 1) % N, s) for d in range(N) for s in ((d + 1) % N, (d + 4) % N)], N
)


def ring():
    x, y = RADIUS + 0.8 * RADIUS * np.array([np.cos(ANGLES), np.sin(ANGLES)])
    electrodes = tuple(
        Electrode(on="top", shape="round", width=0.004, x=float(a), y=float(b))
        for a, b in zip(x, y, strict=True)
    )
    return SensorDesign(Disc(RADIUS), 0.003, electrodes, encapsulated_thickness=0.003)


def answers(places, signs=1.0):
    """Ideal answers by the fields of point electrodes in an unbounded sheet."""
    z = (places - RADIUS) @ [1.0, 1j]
    field = 1.0 / (z[:, None] - 0.8 * RADIUS * np.exp(1j * ANGLES))
    rows = np.array(PROTOCOL.table)
    drive = field[:, rows[:, 0]] - field[:, rows[:, 1]]
    sense = field[:, rows[:, 2]] - field[:, rows[:, 3]]
    return signs * np.real(drive * sense.conj()) * RADIUS**2


def test_rotations_of_a_ring_are_found_and_only_with_their_channels():
    sectors = Sectors.of(ring(), PROTOCOL)
    assert sectors.turned.shape == (N, len(PROTOCOL))
    places = RADIUS + np.random.default_rng(0).uniform(-0.02, 0.02, (5, 2))
    turned = np.empty((5, len(PROTOCOL)))
    turned[:, sectors.turned[2]] = answers(places)
    np.testing.assert_allclose(turned, answers(sectors.rotated(places, 2)), atol=1e-12)
    fewer = Protocol(PROTOCOL.table[1:], N)
    assert Sectors.of(ring(), fewer) is None
    assert Sectors.of(None, PROTOCOL) is None
    assert Sectors.of(ring(), Protocol.pairwise(N)).turned.shape == (N, 15)
    half_turn = Sectors.of(SensorDesign.reference(), Protocol.adjacent(8))
    assert half_turn.turned.shape == (2, 40)
    square = dataclasses.replace(ring(), electrodes=ring().electrodes[:5])
    assert Sectors.of(square, Protocol.adjacent(5)) is None


def test_gains_and_signs_are_found_from_few_presses():
    sectors = Sectors.of(ring(), PROTOCOL)
    rng = np.random.default_rng(1)
    places = RADIUS + rng.uniform(-0.025, 0.025, (12, 2))
    signs = np.where(rng.random(len(PROTOCOL)) < 0.5, -1.0, 1.0)
    sizes = np.exp(0.2 * rng.standard_normal(len(PROTOCOL)))
    seen = answers(places, signs * sizes)
    gains = sectors.gains(PlaceKernel(0.04), Presses.of(places, np.ones(12), seen))
    for orbit in sectors.turned.T:
        relative = gains[orbit] / (signs * sizes)[orbit]
        assert len(set(np.sign(relative))) == 1
        assert np.std(np.log(np.abs(relative))) < 0.25


def test_copies_keep_their_owner():
    sectors = Sectors.of(ring(), PROTOCOL)
    places = RADIUS + np.array([[0.01, 0.0], [0.0, 0.02]])
    presses = sectors.shared(Presses.of(places, np.ones(2), answers(places)), 0.1)
    assert len(presses.strength) == 2 * N
    np.testing.assert_array_equal(presses.owner, np.tile([0, 1], N))
    np.testing.assert_array_equal(presses.weight, np.repeat([1.0, 0.1], [2, 2 * (N - 1)]))
    np.testing.assert_allclose(presses.answers, answers(presses.places), atol=1e-12)


@pytest.mark.slow
def test_span_of_a_design_holds_the_maps_of_its_protocol():
    """Any sensitivity is a combination of the span's maps: here against those of point sources."""
    span = design_span(ring())
    places = RADIUS + np.random.default_rng(2).uniform(-0.022, 0.022, (200, 2))
    features, wanted = span.features(places), answers(places)
    found = features @ np.linalg.lstsq(features, wanted, rcond=1e-6)[0]
    assert np.linalg.norm(found - wanted) < 0.03 * np.linalg.norm(wanted)
