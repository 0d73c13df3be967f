"""Every fault of the table, and its effect on the host."""

import itertools
import re
from collections import deque
from pathlib import Path

import numpy as np
import pytest

from eitskin.errors import DeviceError
from eitskin.hardware import Connection, SerialBoard, open_board
from eitskin.hardware.virtual.fault_table import FAULTS, SHORT, read_faults
from eitskin.hardware.virtual.virtual_board import virtual_terminal
from eitskin.simulator import Protocol, Status

from loopback import FLAT, FakeSimulator, Loopback, connected, firmware, take, virtual

FRAMES = 12
SMALL, LARGE = Protocol.pairwise(8), Protocol.adjacent(32)  # one packet a frame, and nine
PART = "part of an incomplete frame"
DAMAGE = {  # numbers that are missing, those lost, and what was dropped why
    "bit_flip@4:1000": ([4], 1, {"bad checksum"}),
    "dropped_byte@4:100": ([4], 1, {"bad checksum", "bad stuffing"}),
    "inserted_byte@4:100": ([4], 1, {"bad checksum", "bad stuffing"}),
    "burst@4:100": ([4], 1, {"bad checksum", "bad stuffing", "too short"}),
    "truncated@4:100": ([4], 1, {"bad checksum", "bad stuffing"}),
    "merged@4": ([4, 5], 2, {"bad checksum", "bad stuffing"}),
    "duplicated@4": ([], 0, {"repeated or late frame"}),
    "lost_frame@4": ([4], 1, set()),
    "reordered@4": ([4], 1, {"repeated or late frame"}),
    "garbage@4": ([], 0, {"bad checksum", "bad stuffing", "too short"}),
    "text@4": ([], 0, {"bad stuffing", "too short", "bad checksum"}),
    "oversized@4": ([], 0, {"too long"}),
    "back_pressure@4:2": ([], 0, set()),
    "already_streaming": ([], 0, set()),
    "no_reply@0:2": ([], 0, set()),
    "late_reply@1:2": ([], 0, set()),
}
PART_DAMAGE = {
    "bit_flip@4:10000": ([4], 1, {"bad checksum", PART}),
    "merged@4": ([4, 5], 2, {"too long", "bad stuffing", PART}),
    "lost_part@4:4": ([4], 1, {PART}),
    "lost_part@4:8": ([4], 1, {PART}),
    "duplicated_part@4": ([], 0, {PART}),
    "reordered_parts@4:3": ([4], 1, {PART}),
    "merged_frames@4:6": ([4, 5], 2, {PART}),
    "late_reply@1:2": ([], 0, set()),
}


def faulty(text):
    return connected(firmware(read_faults(text)))


@pytest.mark.parametrize(
    ("protocol", "text"),
    [*((SMALL, text) for text in DAMAGE), *((LARGE, text) for text in PART_DAMAGE)],
)
def test_damage_costs_what_was_damaged_and_never_gives_a_wrong_frame(protocol, text):
    missing, lost, reasons = (DAMAGE if protocol == SMALL else PART_DAMAGE)[text]

    def values(number):
        """Impedances of a frame that differ from those of all others."""
        return 100.0 * number + np.arange(len(protocol)) / 16.0

    sensor = (lambda _: FLAT) if protocol == SMALL else values
    board, _ = connected(firmware(read_faults(text), sensor, protocol))
    assert board.protocol == protocol
    frames = take(board, FRAMES)
    first = frames[0].number
    expected = [number for number in range(first, 99) if number not in missing][:FRAMES]
    assert [frame.number for frame in frames] == expected
    assert board.lost == lost
    assert bool(board.counts.dropped) == bool(reasons)
    assert set(board.counts.dropped) <= reasons
    assert all(np.allclose(frame.impedance, sensor(frame.number)) for frame in frames)


def test_jitter_delays_every_frame_by_less_than_a_period():
    board = firmware(read_faults("jitter@3:1"))
    delays = [board.frame() and board.delay for _ in range(200)]
    assert delays[:3] == [0.0] * 3
    assert 0.0 < min(delays[3:]) < max(delays[3:]) < 0.2968
    assert np.std(delays[3:]) == pytest.approx(0.2968 / np.sqrt(12), rel=0.01)


@pytest.mark.parametrize("text", ["wrong_baud@6", "wrong_version@6"])
def test_a_line_that_goes_wrong_gives_nothing_false_and_comes_back_when_mended(text):
    board, port = faulty(text)
    waits = []

    def wait(_):
        waits.append(1)
        if len(waits) == 2:
            port.firmware.stage.clear()

    frames = list(itertools.islice(Connection(board, wait=wait).frames(), FRAMES))
    assert all(np.allclose(frame.impedance, FLAT) for frame in frames)
    assert [frame.number for frame in frames[:6]] == list(range(6))
    assert board.lost == frames[6].number - 6
    assert {frame.session for frame in frames} == {1}
    assert board.counts.dropped


@pytest.mark.parametrize(("text", "first"), [("reboot@4", 0), ("counter_wrap@4", 2**32 - 3)])
def test_a_reboot_is_a_new_session_whose_numbers_may_wrap(text, first):
    board, _ = faulty(text)
    frames = take(board, FRAMES)
    assert [frame.session for frame in frames] == [1] * 4 + [2] * 8
    assert [frame.number for frame in frames[4:]] == [(first + i) % 2**32 for i in range(8)]
    assert frames[4].time == pytest.approx(0.0)
    assert (board.lost, board.counts.dropped) == (0, {})


@pytest.mark.slow
def test_a_port_in_use_is_refused_until_free_and_taken_when_its_host_lets_go():
    with pytest.raises(DeviceError, match="another program"):
        virtual(faults="port_in_use")
    with virtual() as board:
        frames = Connection(board, wait=lambda _: tries.append(board.stage.clear())).frames()
        tries = []
        next(frames)
        board.stage.inject("port_in_use, replug")
        while next(frames).session == 1:
            pass
        assert tries
    with virtual_terminal(speed="max", simulator=FakeSimulator()) as terminal:
        uri = f"serial:{terminal.path}"
        with open_board(uri) as board:
            terminal.firmware.stage.inject("port_in_use")
            assert len(take(board, 50)) == 50
        free = map(open_board, itertools.repeat(uri))
        with pytest.raises(DeviceError, match="another program"):
            deque((board.close() for board in free), 0)  # until it is taken


# ---- values ----


@pytest.mark.parametrize(
    ("text", "frame", "channel", "rest", "status"),
    [
        ("nan_channel@2:5", 2, np.nan, 1.0, Status.NOT_FINITE),
        ("inf_channel@2:5", 2, np.inf, 1.0, Status.NOT_FINITE),
        ("clipping@2:5", 2, 0.7, 1.0, Status.CLIPPED),
        ("wrong_rtia@2", 10, 0.2, 0.2, 0),
        ("phase_360@2", 10, 1.0, 1.0, 0),
        ("gain_step@2", 10, 1.02, 1.02, 0),
        ("drift_ramp@2", 10, 1.0008, 1.0008, 0),
    ],
)
def test_values_change_by_factors_and_are_marked(text, frame, channel, rest, status):
    frames = take(faulty(text)[0], FRAMES)
    assert np.allclose(frames[1].impedance, FLAT)
    assert not frames[1].status.any()
    factors, fifth = frames[frame].impedance.real / FLAT, np.arange(28) == 5
    assert factors == pytest.approx(np.where(fifth, channel, rest), rel=2e-6, nan_ok=True)
    assert np.array_equal(frames[frame].status, fifth * status)


@pytest.mark.parametrize(("name", "frozen"), [("frozen_frame", 28), ("stuck_channel", 1)])
def test_what_is_stuck_has_no_noise_left(name, frozen):
    rng = np.random.default_rng(0)
    noisy = firmware(read_faults(f"{name}@2:7"), sensor=lambda _: FLAT + rng.normal(size=28))
    frames = np.array([frame.impedance for frame in take(connected(noisy)[0], FRAMES)])
    still = (frames[2:] == frames[2]).all(axis=0)
    assert (still.sum(), still[7]) == (frozen, True)
    assert not (frames[:3] == frames[2]).all(axis=0).any()


# ---- names ----


def test_every_fault_is_read_back_and_all_at_once_end_in_frames_or_a_device_error():
    """Whatever is combined: no other exception, and no value that was not sent."""
    for name, kind in FAULTS.items():
        (fault,) = read_faults(f"{name}@17:3")
        assert (fault.kind, fault.frame, fault.index) == (kind, 17, 3)
        assert str(fault) == f"{name}:3"
        assert kind.unit or "`index`" not in kind.meaning
    page = (Path(__file__).parents[2] / "docs" / "reference" / "live.md").read_text("utf-8")
    table = page.partition("\n## Faults of virtual boards\n")[2].partition("\n## ")[0]
    rows = [row for row in table.splitlines() if row.startswith("| ")][1:]
    assert sorted(re.findall(r"\w+", " ".join(rows))) == sorted(FAULTS)
    rng = np.random.default_rng(5)
    names = [name for name in FAULTS if "unplug" not in name and name not in ("replug",)]
    for _ in range(30):
        chosen = rng.choice(names, 4, replace=False)
        text = ",".join(f"{name}@{rng.integers(12)}:{rng.integers(300)}" for name in chosen)
        port = Loopback(firmware(read_faults(text)))
        try:
            board = SerialBoard(lambda port=port: port, "serial:x", clock=port.clock)
            frames = take(board, FRAMES)
        except DeviceError:
            continue
        assert [len(frame.impedance) for frame in frames] == [28] * FRAMES


# ---- network faults ----


N = 8
PROTOCOLS = {
    "pairwise": Protocol.pairwise(N),
    "adjacent": Protocol.adjacent(N),
    "table": Protocol(((0, 3, 1, 2), (5, 2, 5, 7), (6, 1, 4, 0), (3, 4, 2, 6)), N),
}


def resistors():
    """Conductance matrix (N, N) [S] of resistors between all electrodes."""
    G = np.triu(np.random.default_rng(0).uniform(1e-4, 3e-3, (N, N)), 1)
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
    simulator = Resistors(protocol)
    with open_board("virtual:?speed=max&snr_db=inf", simulator=simulator, faults=fault) as board:
        return take(board, count)


@pytest.fixture(params=PROTOCOLS)
def protocol(request):
    return PROTOCOLS[request.param]


def test_faults_of_electrodes_are_those_of_a_network_of_resistors(protocol):
    """Ground is the mean of the others; 100 pF at 40 kHz is 39.8 kohm."""
    for channel in (0, 3):
        b = np.zeros(N)
        one, other = protocol.table[channel][:2]
        b[[one, other]] = 1.0, -1.0
        (frame,) = frames(f"shorted_pair@0:{channel}", protocol)
        expected = readings(G + np.outer(b, b) / SHORT, protocol)
        np.testing.assert_allclose(frame.impedance, expected, rtol=1e-5, atol=1e-4)
        assert not np.allclose(frame.impedance, readings(G, protocol), rtol=0.01)
    swapped = {2: 3, 3: 2}
    table = tuple(tuple(swapped.get(e, e) for e in row) for row in protocol.table)
    (frame,) = frames("swapped_electrodes@0:2", protocol)
    expected = readings(G, Protocol(table, N))
    np.testing.assert_allclose(frame.impedance, expected, rtol=1e-5, atol=1e-4)
    first, last = frames("contact_loss@0:5", protocol, 5)[::4]
    table = np.array(protocol.table) == 5
    both = table[:, :2].any(axis=1) & table[:, 2:].any(axis=1)
    before = readings(G, protocol)
    np.testing.assert_allclose(first.impedance, before, rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(last.impedance[~both], before[~both], rtol=1e-5, atol=1e-4)
    grown = np.abs(last.impedance - before)[both]
    pairs = readings(G, Protocol(tuple((5, k, 5, k) for k in range(N) if k != 5), N))
    np.testing.assert_allclose(grown, 0.2 * pairs.real.mean(), rtol=1e-4)
    (frame,) = frames("open_electrode@0:4", protocol)
    involved = (np.array(protocol.table) == 4).any(axis=1)
    assert np.array_equal(frame.status == Status.OPEN, involved)
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
            assert abs(value) == pytest.approx(39.8e3, rel=1e-3)
