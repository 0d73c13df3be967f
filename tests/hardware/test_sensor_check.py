"""Sensor check: no findings for healthy sensors, the right ones for others."""

import dataclasses
import itertools
import json
import types
from functools import lru_cache

import command_line
import numpy as np
import pytest

from eitskin.datasets import Recipe
from eitskin.datasets.recipe.frame_sampling import specimen
from eitskin.geometry import SensorDesign
from eitskin.hardware import open_board
from eitskin.hardware.boards import port
from eitskin.hardware.boards.port import PortInfo
from eitskin.hardware.diagnosis.checked_frames import FindingKind
from eitskin.hardware.diagnosis.sensor_check import check_sensor
from eitskin.hardware.virtual import virtual_board as virtual
from eitskin.simulator import Frame, Instrument, Protocol, Scene, Simulator, Status

PROTOCOL = Protocol.pairwise(8)
PAIRS = [row[:2] for row in PROTOCOL.table]
FULL_SCALE, FRAMES = 846.0, 16


@lru_cache
def matrix(number=None):
    """Noise-free impedance matrix of a specimen, or of the design."""
    recipe = Recipe.from_shipped("training")
    design = recipe.sensor if number is None else specimen(recipe, number).design
    return Simulator(design, recipe.resolution).impedance_matrix(Scene())


def flat(number=None):
    return PROTOCOL.measure(matrix(number)).astype(complex)


def expected():
    return np.abs(flat())


def frames(truth, count=FRAMES, seed=0, instrument=None):
    rng = np.random.default_rng(seed)
    session = (instrument or Instrument.ad5940()).session(PROTOCOL, FULL_SCALE, rng)
    times = 0.3 * np.arange(count)
    truth = np.broadcast_to(truth, (count, 28)).astype(complex)
    found = zip(*session.measure(truth, times, rng), times, strict=True)
    return [Frame(z, PROTOCOL, t, k, status=s) for k, (z, s, t) in enumerate(found)]


def check(truth, **options):
    return check_sensor(frames(truth, **options), expected())


def at(electrode):
    return np.array([electrode in pair for pair in PAIRS])


def found(result):
    return [(each.what, each.electrodes) for each in result.findings]


# ---- healthy sensors ----


@pytest.mark.slow
def test_healthy_specimens_and_boards_are_not_accused_by_check_or_command():
    for number in range(4):
        assert check(flat(number), seed=number).findings == ()
    for snr_db in (60.0, 90.0):
        board = dataclasses.replace(Instrument.ad5940(), snr_db=snr_db)
        assert check(flat(), instrument=board).healthy
    result = command_line.run("check", "--board", "virtual:?speed=max", "--frames", "8")
    assert result.exit_code == 0
    assert "8 frames" in result.stdout
    assert "flat" in result.stderr


def test_a_few_frames_are_enough_and_ohms_are_of_the_right_scale():
    one = flat(0) + 400.0 * at(6)
    assert check(flat(0), count=1).healthy
    assert found(check(one, count=1)) == [(FindingKind.BAD_CONTACT, (6,))]
    given = [
        dataclasses.replace(each, impedance=5.0 * each.impedance)
        for each in frames(flat() + 300.0 * at(5))
    ]
    factor, contact = check_sensor(given, expected()).findings
    assert (factor.what, contact.electrodes) == (FindingKind.FACTOR, (5,))
    assert "5 times" in factor.message
    assert float(contact.message.split(", ")[1].split()[0]) == pytest.approx(300.0, abs=25.0)


# ---- one fault ----

CHANNELS, NOISE = np.arange(28), np.random.default_rng(0).standard_normal((FRAMES, 28))
LATE = (np.arange(FRAMES) >= 6)[:, None]
FAULTS = {  # of the virtual board: at how many places, and the one finding at each
    "open_electrode": (8, lambda k: (FindingKind.OPEN, (k,), None)),
    "shorted_pair": (28, lambda k: (FindingKind.SHORT, PAIRS[k], None)),
    "swapped_electrodes": (
        *(8, lambda k: (FindingKind.SWAPPED, tuple(sorted((k, (k + 1) % 8))), None)),
    ),
    "stuck_channel": (28, lambda k: (FindingKind.STUCK, (), (k,))),
    "nan_channel": (28, lambda k: (FindingKind.NOT_FINITE, (), (k,))),
    "clipping": (28, lambda k: (FindingKind.CLIPPED, (), (k,))),
    "frozen_frame": (1, lambda _: (FindingKind.FROZEN, (), None)),
    "wrong_rtia": (1, lambda _: (FindingKind.FACTOR, (), None)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FAULTS)
def test_each_fault_is_named_at_each_place_and_nothing_else_is(name):
    places, finding = FAULTS[name]
    sensor = types.SimpleNamespace(protocol=PROTOCOL, impedance_matrix=lambda _: matrix(1))
    for k in range(0, places, 1 + places // 10):
        uri = f"virtual:?speed=max&instrument=ad5940&seed={k}&faults={name}@0:{k}"
        with open_board(uri, simulator=sensor) as board:
            result = check_sensor(list(itertools.islice(board.frames(), FRAMES)), expected())
        assert_one(result, *finding(k))


def assert_one(result, what, electrodes, channels=None):
    (finding,) = result.findings
    assert (finding.what, finding.electrodes) == (what, electrodes)
    assert channels is None or finding.channels == channels


@pytest.mark.parametrize("ohm", [100.0, 150.0, 300.0, 2000.0])  # a good one has about 60
def test_a_bad_contact_is_named(ohm):
    for e in range(8):
        assert_one(check(flat(1) + ohm * at(e), seed=e), FindingKind.BAD_CONTACT, (e,), None)


@pytest.mark.slow
def test_bad_channels_and_several_faults_are_named_together():
    for k in range(0, 28, 3):
        noisy = flat(1) * (1.0 + 0.01 * NOISE * (CHANNELS == k))
        assert_one(check(noisy, seed=k), FindingKind.NOISY, (), (k,))
        off = flat(1) * (1.0 + 0.1 * (CHANNELS == k))
        assert_one(check(off, seed=k), FindingKind.MISFIT, (), (k,))
    turned = [tuple(sorted({0: 3, 3: 0}.get(e, e) for e in pair)) for pair in PAIRS]
    ill = flat(3)[[PAIRS.index(pair) for pair in turned]] + 300.0 * at(5)
    ill[at(6)] = -39.8e3j
    assert set(found(check(ill))) == {
        (FindingKind.OPEN, (6,)),
        (FindingKind.SWAPPED, (0, 3)),
        (FindingKind.BAD_CONTACT, (5,)),
    }


@pytest.mark.parametrize(
    ("truth", "what", "electrodes", "channels"),
    [
        (flat() * (1.0 + 0.002 * np.sin(CHANNELS) * LATE), FindingKind.MOVED, (), None),
        (flat() * (1.0 + 0.05 * np.cos(2.0 * CHANNELS)), FindingKind.MISFIT, (), None),  # bent
        (flat() * (1.0 + 0.02 * NOISE), FindingKind.NOISY, (), tuple(range(28))),
        (np.full(28, -39.8e3j), FindingKind.OPEN, tuple(range(8)), None),  # nothing connected
        (np.where(CHANNELS == 9, -39.8e3j, flat()), FindingKind.OPEN, (), (9,)),
        (np.where(at(4), -39.8e3j, flat()), FindingKind.OPEN, (4,), None),  # not marked
        (flat() * np.exp(1j * np.deg2rad(30.0)), FindingKind.PHASE, (), None),
    ],
)
def test_one_cause_is_one_finding(truth, what, electrodes, channels):
    assert_one(check(truth), what, electrodes, channels)


ALL = np.ones(28, bool)


@pytest.mark.parametrize(
    ("channels", "factor", "status", "finding", "message"),
    [
        (at(2), np.inf, 0, (FindingKind.NOT_FINITE, (2,)), ""),
        (at(2), np.nan, Status.OPEN | Status.NOT_FINITE, (FindingKind.OPEN, (2,)), ""),
        (ALL, np.nan, 0, (FindingKind.NOT_FINITE, ()), ""),
        (ALL, 1.0, Status.UNCALIBRATED, (FindingKind.BOARD, ()), "calibrate the board"),
        (ALL, 1.0, Status.DFT_TIMEOUT, (FindingKind.BOARD, ()), "timed out"),
        (ALL, 1.0, Status.FIFO_OVERFLOW, (FindingKind.BOARD, ()), "memory"),
    ],
)
def test_marks_of_the_board_and_values_that_are_no_numbers_are_one_finding(
    channels, factor, status, finding, message
):
    marked = [
        dataclasses.replace(
            each,
            impedance=np.where(channels, factor, 1.0) * each.impedance,
            status=np.where(channels, status, 0),
        )
        for each in frames(flat())
    ]
    result = check_sensor(marked, expected())
    assert found(result) == [finding]
    assert message in result.findings[0].message


# ---- other protocols, and what cannot be ----


def test_other_protocols_say_what_can_be_said_and_small_readings_are_no_fault():
    """Those far from the driven electrodes lie in the noise, and depend on where electrodes are."""
    protocol = Protocol.adjacent(8)
    values = np.linspace(20.0, 60.0, len(protocol))
    noise = np.random.default_rng(0).standard_normal((FRAMES, len(protocol)))
    measured = values * (1.0 + 1e-4 * noise)
    assert check_sensor([Frame(z, protocol) for z in measured], values).healthy
    measured[:, 4] = measured[0, 4]
    (finding,) = check_sensor([Frame(z, protocol) for z in measured], values).findings
    assert (finding.what, finding.channels) == (FindingKind.STUCK, (4,))
    (finding,) = check_sensor([Frame(6.0 * z, protocol) for z in measured[:1]], values).findings
    assert finding.what == FindingKind.FACTOR
    measured[:, 7] = [0.0] * 12 + [4e-4 * values[7]] * 4  # 0.4 % of the least unit
    *_, finding = check_sensor([Frame(z, protocol) for z in measured], values).findings
    assert (finding.what, finding.channels) == (FindingKind.MOVED, (7,))
    measured[:, 9] *= 0.01  # no short, as it is not driven where it is sensed
    assert FindingKind.SHORT not in {
        each.what for each in check_sensor([Frame(z, protocol) for z in measured], values).findings
    }
    protocol = Protocol.adjacent(16)
    expected, rng = np.geomspace(54.0, 0.002, len(protocol)), np.random.default_rng(0)
    truth = expected * np.exp(0.1 * rng.normal(size=len(protocol)))
    truth[-5:] = 0.2  # a hundred times as much
    noise = 54.0 * 10 ** (-75 / 20)

    def frames(noise):
        return [Frame(truth + noise * rng.normal(size=len(truth)), protocol) for _ in range(FRAMES)]

    assert check_sensor(frames(noise), expected).healthy
    truth[10] *= 60.0
    (finding,) = check_sensor(frames(noise), expected).findings
    assert (finding.what, finding.channels) == (FindingKind.OPEN, (10,))
    truth[10] /= 60.0
    (finding,) = check_sensor(frames(30.0 * noise), expected).findings
    assert finding.what == FindingKind.NOISY


@pytest.mark.parametrize("protocol", [Protocol.adjacent(8), Protocol.opposite(8)], ids=str)
def test_faults_of_electrodes_in_four_terminal_frames(protocol):
    """A short is named by its pair; a swap only as other values than those of the design."""
    Z = Simulator(SensorDesign.reference(), "coarse").impedance_matrix(Scene())
    healthy = protocol.measure(Z)
    noise = np.random.default_rng(0).standard_normal((FRAMES, len(protocol)))

    def findings(matrix):
        values = protocol.measure(matrix) + 1e-5 * np.abs(healthy).max() * noise
        return found(check_sensor([Frame(z, protocol) for z in values], np.abs(healthy)))

    assert findings(Z) == []
    one, other = protocol.table[0][:2]
    between = Z[:, one] - Z[:, other]
    shorted = Z - np.outer(between, between) / (0.1 + between[one] - between[other])
    assert (FindingKind.SHORT, (one, other)) in findings(shorted)
    assert {what for what, _ in findings(shorted)} == {FindingKind.SHORT}
    order = [0, 1, 5, 3, 4, 2, 6, 7]
    assert (FindingKind.MISFIT, ()) in findings(Z[np.ix_(order, order)])
    assert findings(6.0 * Z) == [(FindingKind.FACTOR, ())]


# ---- the command ----


kept_simulator = lru_cache(Simulator)  # of the sensor that all of the boards have


@pytest.mark.slow
def test_the_command_names_the_fault_of_a_virtual_board(monkeypatch):
    monkeypatch.setattr(virtual, "Simulator", kept_simulator)
    board = "virtual:?speed=max&faults=nan_channel@0:4"
    said = json.loads(command_line.run("check", "--json", "--board", board, code=4).stdout)
    (finding,) = said["findings"]
    assert (finding["what"], finding["electrodes"]) == ("not finite", [])
    assert (finding["channels"], said["healthy"]) == (["0-5"], False)


def test_the_command_lists_ports(monkeypatch):
    ports = (PortInfo("/dev/ttyS0"), PortInfo("/dev/ttyACM0", "EIT board", "ST", 1155, 1, "20 5A"))
    monkeypatch.setattr(port, "serial_ports", lambda: ports)
    listed = json.loads(command_line.run("ports", "--json").stdout)["ports"]
    assert [each["uri"] for each in listed] == ["serial:/dev/ttyS0", "serial:?usb=20%205A"]
    last = "serial:?usb=20%205A  /dev/ttyACM0 (EIT board, ST, 0483:0001, 20 5A)"
    assert command_line.run("check", "--list").stdout.splitlines()[-1] == last  # as in version 0.2
    monkeypatch.setattr(port, "serial_ports", lambda: ())
    assert "no serial port" in command_line.run("ports").stdout
