"""The AD5940's chain on protocols whose measurements do not sense their drive pair."""

import dataclasses

import numpy as np
import pytest

from eitskin.geometry import SensorDesign
from eitskin.simulator import Instrument, Protocol, Scene, Simulator, Status, Touch
from eitskin.simulator.instrument.meter import FourTerminalMeter

N = 8
OMEGA = 2 * np.pi * 40e3
QUIET = dataclasses.replace(Instrument.ideal())
ADJACENT, OPPOSITE = Protocol.adjacent(N), Protocol.opposite(N)


def network(seed=0, ohm=300.0):
    """Impedance matrix (N, N) of a lossy random network [ohm], with zero sums."""
    root = np.random.default_rng(seed).standard_normal((N, N))
    centred = np.eye(N) - 1.0 / N
    contacts = np.diag(1.0 + 0.1j * np.arange(N))
    return ohm / N * centred @ (root @ root.T + contacts) @ centred


Z = network()


def measured(instrument, protocol, matrix=Z, frames=1, full_scale=100.0, seed=0):
    """Readings and status of `frames` frames of one session."""
    rng = np.random.default_rng(seed)
    session = instrument.session(protocol, full_scale, rng)
    both = instrument.terminal_impedances(matrix, protocol)
    return session.measure(np.tile(both, (frames, 1, 1)), np.zeros(frames), rng)


def only(**terms):
    return dataclasses.replace(QUIET, **terms)


@pytest.mark.parametrize("protocol", [ADJACENT, OPPOSITE, Protocol.pairwise(N)], ids=str)
def test_terminal_impedances_are_those_of_a_current_through_the_drive_pair(protocol):
    both = Instrument.ad5940().terminal_impedances(Z, protocol)
    for i, (a, b, c, d) in enumerate(protocol.table):
        V = Z[:, a] - Z[:, b]
        assert both[0, i] == pytest.approx(V[c] - V[d], rel=1e-12)
        assert both[1, i] == pytest.approx(V[a] - V[b], rel=1e-12)


def test_a_loaded_drive_pair_has_its_leads_and_loads():
    """Two electrodes, one resistor: the source sees it between its leads, both loads beside it."""
    meter = FourTerminalMeter(source=2e-3, sink=1e-3, leads=(5.0, 7.0))
    R = 100.0
    matrix = R / 4 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    both = meter.terminal_impedances(matrix, Protocol(((0, 1, 0, 1),), 2))
    through_ground = 1 / 2e-3 + 1 / 1e-3
    expected = 1 / (1 / (R + 12.0) + 1 / through_ground)
    assert both[1, 0] == pytest.approx(expected, rel=1e-12)


def test_stray_capacitance_across_the_drive_pair_is_that_of_the_circuit():
    """The capacitor is a further element of the network, whose nodal equations are solved."""
    C = 1e-9
    found, _ = measured(only(stray_capacitance=(C, C)), ADJACENT)
    Y = np.linalg.pinv(Z)
    for (a, b, c, d), value in zip(ADJACENT.table, found[0], strict=True):
        e = np.zeros(N)
        e[[a, b]] = 1.0, -1.0
        V = np.linalg.pinv(Y + 1j * OMEGA * C * np.outer(e, e)) @ e
        assert value == pytest.approx(V[c] - V[d], rel=1e-9)


def test_the_drive_pair_limits_the_current_and_the_sensed_voltage_its_range():
    """Drive pairs of 100 ohm take 0.607 V only up to 3 mA: 121 mV is the largest that fits."""
    both = np.array([[0.5], [100.0]])[None].astype(complex)
    rows = Protocol(((0, 1, 2, 3),), 4)
    full = only(clipping=True, quantisation=True)
    session = full.session(rows, 1.0, np.random.default_rng(0))
    (value,), (status,) = session.measure(both, np.zeros(1), np.random.default_rng(0))
    assert not status.any()
    current = 0.121 / 100.0
    code = 0.133 / 2**17 / current
    assert value[0].real == pytest.approx(round(0.5 / code) * code, rel=2e-5)
    forced = dataclasses.replace(full, excitation=0.607).session(
        rows, 1.0, np.random.default_rng(0)
    )
    _, (clipped,) = forced.measure(both, np.zeros(1), np.random.default_rng(0))
    assert clipped.tolist() == [Status.CLIPPED]


def test_every_term_acts_on_four_terminal_frames_of_a_sensor():
    sim = Simulator(SensorDesign.reference(), "coarse", protocol=ADJACENT)
    board = Instrument.ad5940()
    scene = Scene(touches=(Touch(0.05, 0.03, 10.0),))
    clean, frame = sim.measure(scene), sim.measure(scene, board, np.random.default_rng(1))
    assert not frame.status.any()
    error = np.abs(frame.impedance - clean.impedance)
    assert (error < 0.02 * np.abs(clean.impedance) + 8 * board.deviation(sim.full_scale)).all()
    assert (error > 0.0).all()
