"""Faults of the network between the electrodes, on boards of any protocol, by nodal analysis."""

import itertools

import numpy as np
import pytest

from eitskin.hardware import open_board
from eitskin.hardware.virtual.fault_table import SHORT, read_faults
from eitskin.simulator import Protocol, Status

N = 8
PROTOCOLS = {
    "pairwise": Protocol.pairwise(N),
    "adjacent": Protocol.adjacent(N),
    "opposite": Protocol.opposite(N),
    "table": Protocol(((0, 3, 1, 2), (5, 2, 5, 7), (6, 1, 4, 0), (3, 4, 2, 6)), N),
}


def resistors(seed=0):
    """Conductance matrix (N, N) [S] of resistors between all electrodes."""
    rng = np.random.default_rng(seed)
    G = np.triu(rng.uniform(1e-4, 3e-3, (N, N)), 1)
    G = G + G.T
    return np.diag(G.sum(axis=1)) - G


G = resistors()


def readings(conductance, protocol):
    """Transfer impedances of a floating network, by its nodal equations with node 0 at ground."""
    inverse = np.zeros((N, N), complex)
    inverse[1:, 1:] = np.linalg.inv(conductance[1:, 1:])
    return np.array([inverse[c, a] - inverse[c, b] - inverse[d, a] + inverse[d, b]
                     for a, b, c, d in protocol.table])  # fmt: skip


class Resistors:
    def __init__(self, protocol):
        self.protocol = protocol

    def impedance_matrix(self, _):
        return np.linalg.pinv(G)


def frames(fault, protocol, count=1):
    """Frames of a noise-free board under a fault from its first frame on."""
    with open_board(
        "virtual:?speed=max&snr_db=inf", simulator=Resistors(protocol), faults=f"{fault}"
    ) as board:
        return list(itertools.islice(board.frames(), count))


@pytest.fixture(params=PROTOCOLS)
def protocol(request):
    return PROTOCOLS[request.param]


def test_a_faultless_board_reads_the_network(protocol):
    (frame,) = frames("", protocol)
    np.testing.assert_allclose(frame.impedance, readings(G, protocol), rtol=1e-6, atol=1e-4)


def test_a_short_is_a_further_resistor_between_the_two_electrodes(protocol):
    for channel in (0, 3):
        b = np.zeros(N)
        one, other = protocol.table[channel][:2]
        b[[one, other]] = 1.0, -1.0
        (frame,) = frames(f"shorted_pair@0:{channel}", protocol)
        expected = readings(G + np.outer(b, b) / SHORT, protocol)
        np.testing.assert_allclose(frame.impedance, expected, rtol=1e-5, atol=1e-4)
        assert not np.allclose(frame.impedance, readings(G, protocol), rtol=0.01)


def test_swapped_electrodes_read_as_a_table_with_both_exchanged(protocol):
    swapped = {2: 3, 3: 2}
    table = tuple(tuple(swapped.get(e, e) for e in row) for row in protocol.table)
    (frame,) = frames("swapped_electrodes@0:2", protocol)
    expected = readings(G, Protocol(table, N))
    np.testing.assert_allclose(frame.impedance, expected, rtol=1e-5, atol=1e-4)


def test_a_worse_contact_shows_only_where_current_and_voltage_pass_it(protocol):
    first, last = frames("contact_loss@0:5", protocol, 5)[::4]
    table = np.array(protocol.table) == 5
    both = table[:, :2].any(axis=1) & table[:, 2:].any(axis=1)
    before = readings(G, protocol)
    np.testing.assert_allclose(first.impedance, before, rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(last.impedance[~both], before[~both], rtol=1e-5, atol=1e-4)
    grown = np.abs(last.impedance - before)[both]
    pairs = readings(G, Protocol(tuple((5, k, 5, k) for k in range(N) if k != 5), N))
    np.testing.assert_allclose(grown, 0.2 * pairs.real.mean(), rtol=1e-4)


def test_a_lead_that_is_off_reads_ground_through_its_capacitance(protocol):
    """Ground is the mean of the others; 100 pF at 40 kHz is 39.8 kohm."""
    (frame,) = frames("open_electrode@0:4", protocol)
    involved = (np.array(protocol.table) == 4).any(axis=1)
    assert np.array_equal(frame.status == Status.OPEN, involved)
    before = readings(G, protocol)
    np.testing.assert_allclose(frame.impedance[~involved], before[~involved], rtol=1e-5, atol=1e-4)
    rest = np.delete(np.arange(N), 4)
    for row, value in zip(protocol.table, frame.impedance, strict=True):
        if 4 in row[2:] and 4 not in row[:2]:
            other = row[3] if row[2] == 4 else row[2]
            against = [readings(G, Protocol(((*row[:2], other, k),), N))[0] if k != other else 0.0
                       for k in rest]  # fmt: skip
            sign = -1.0 if row[2] == 4 else 1.0
            assert value == pytest.approx(sign * np.mean(against), rel=1e-4, abs=1e-3)
        elif 4 in row[:2] and 4 in row[2:]:
            assert abs(value) == pytest.approx(39.8e3, rel=0.05)


def test_faults_of_the_network_stand_beside_those_of_values():
    named = read_faults("shorted_pair,nan_channel")
    assert [fault.name for fault in named] == ["shorted_pair", "nan_channel"]
    protocol = PROTOCOLS["adjacent"]
    (frame,) = frames("swapped_electrodes@0:2,nan_channel@0:1", protocol)
    assert np.flatnonzero(~np.isfinite(frame.impedance)).tolist() == [1]
