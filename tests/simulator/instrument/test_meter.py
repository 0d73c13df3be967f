"""Four-terminal meters against nodal networks, and fitted to frames."""

import dataclasses

import numpy as np
import pytest

from eitskin.errors import ConfigurationError, DataError
from eitskin.simulator import FourTerminalMeter, Instrument, Protocol, Status
from eitskin.simulator.instrument.meter import FIT_PARAMETERS, Parameter
from eitskin.simulator.instrument.meter_fit import agreement, fit_meter, select_meter

FOUR = Protocol(((0, 3, 1, 2),), 4)
RING = Protocol.adjacent(6)
EVERY_ROLE = FourTerminalMeter(
    source=2e-4, sink=5e-4, sense_plus=1e-4, sense_minus=3e-4, idle=2e-5, common_mode=0.3
)


def impedance(conductances, n):
    """Impedance matrix of a network of conductances {(i, j): g}."""
    Y = np.zeros((n, n))
    for (i, j), g in conductances.items():
        Y[[i, j], [i, j]] += g
        Y[[i, j], [j, i]] -= g
    return np.linalg.pinv(Y)


def random_network(n=6):
    rng = np.random.default_rng(1)
    links = {(i, j): rng.uniform(1e-3, 5e-3) for i in range(n) for j in range(i)}
    return impedance(links, n)


def sensed(meter, Z, protocol=FOUR):
    return meter.transfer_impedance(Z, protocol)


# ---- closed forms ----


def test_leads_loads_and_leaks_are_those_of_a_nodal_network():
    """Two electrodes, one resistor: the source sees it between its leads, both loads beside it."""
    Z = random_network()
    leaks = tuple(1e-5 * k for k in range(6))
    meter = dataclasses.replace(EVERY_ROLE, leaks=leaks)
    for row, found in zip(RING.table, sensed(meter, Z, RING), strict=True):
        nodes = np.linalg.pinv(Z) + np.diag(leaks)
        loads = dict(zip(row, (2e-4, 5e-4, 1e-4, 3e-4), strict=True))
        for k in range(6):
            nodes[k, k] += loads.get(k, 2e-5)
        source, sink, plus, minus = row
        current = np.zeros(6)
        current[[source, sink]] = 1.0, -1.0
        V = np.linalg.solve(nodes, current)
        expected = V[plus] - V[minus] + 0.3 * (V[plus] + V[minus]) / 2.0
        assert found == pytest.approx(expected, rel=1e-9)
    R, lead, y = 500.0, 60.0, 1e-3
    two = Protocol.pairwise(2)
    meter = FourTerminalMeter(leads=(lead, 0.0), source=y, sink=y)
    expected = 1.0 / (1.0 / (R + lead) + y / 2.0)
    assert sensed(meter, impedance({(0, 1): 1.0 / R}, 2), two) == pytest.approx(expected, rel=1e-12)
    meter = FourTerminalMeter(source=2e-3, sink=1e-3, leads=(5.0, 7.0))
    R = 100.0
    matrix = R / 4 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    both = meter.terminal_impedances(matrix, Protocol(((0, 1, 0, 1),), 2))
    through_ground = 1 / 2e-3 + 1 / 1e-3
    expected = 1 / (1 / (R + 12.0) + 1 / through_ground)
    assert both[1, 0] == pytest.approx(expected, rel=1e-12)
    ideal = RING.measure(Z)
    np.testing.assert_array_equal(sensed(FourTerminalMeter(scale=3.0), Z, RING), ideal)
    assert not FourTerminalMeter(scale=3.0, offset=1.0, step=0.1).is_loaded
    least = FourTerminalMeter(*5 * (1e-12,), leads=6 * (1e-9,))
    assert sensed(least, Z, RING) == pytest.approx(ideal, rel=1e-6)
    # Leads carry no current where only they are there: four terminals do not see them.
    assert sensed(FourTerminalMeter(leads=6 * (80.0,)), Z, RING) == pytest.approx(ideal, rel=1e-9)


# ---- readings ----


def test_readings_are_scaled_offset_limited_rounded_signed_and_flagged():
    meter = FourTerminalMeter(
        scale=2.0,
        offset=1.0,
        channel_scale=(1.0, 0.5, 1.0),
        channel_offset=(0.0, 0.0, -0.5),
        saturation=10.0,
        step=0.4,
    )
    read, beyond = meter.reading(np.array([[1.07, 1.6, -6.0 + 2.0j]]))
    assert read == pytest.approx(np.array([[3.2, 2.4, -10.0 + 4.0j]]))
    assert beyond.tolist() == [[False, False, True]]
    voltage = np.array([-3.0 + 4.0j, 2.0 - 1.0j])
    for reads, expected in (("signed", [-3, 2]), ("magnitude", [5, np.sqrt(5)])):
        assert FourTerminalMeter(reads=reads).reading(voltage)[0] == pytest.approx(expected)
    meter = FourTerminalMeter(scale=-0.5, saturation=20.0, reads="magnitude")
    board = dataclasses.replace(Instrument.ideal(), meter=meter)
    rng = np.random.default_rng(0)
    session = board.session(Protocol.pairwise(3), 100.0, rng)
    (read,), (status,) = session.measure(np.array([[10.0, 30.0, 60.0 + 0j]]), np.zeros(1), rng)
    assert read == pytest.approx([5.0, 15.0, 20.0])
    assert status.tolist() == [0, 0, Status.CLIPPED]


# ---- refusals and files ----


def test_meter_files_are_read_back_and_those_of_other_sensors_refused(tmp_path):
    meter = dataclasses.replace(
        EVERY_ROLE, leaks=(1e-6, 1e-6j), scale=0.1 - 2j, reads="signed", channel_offset=(1.0, 2.0)
    )
    board = Instrument(snr_db=62.0, meter=meter)
    board.to_toml(tmp_path / "rig.toml")
    assert Instrument.from_toml(tmp_path / "rig.toml") == board
    assert Instrument.from_name(str(tmp_path / "rig.toml")) == board
    known = dataclasses.replace(Instrument.ad5940(), snr_db=0.0)
    for base, expected in (("rig.toml", dataclasses.replace(board, snr_db=0.0)), ("ad5940", known)):
        (tmp_path / "quiet.toml").write_text(f'board = "{base}"\nsnr_db = 0.0\n')
        assert Instrument.from_name("quiet.toml", tmp_path) == expected
    for text, words in (
        ('board = "ad"\n', r"board: .*'ad5940', got 'ad'"),
        ("[meter]\nsense_plu = 1e-3\n", r"meter: unknown key 'sense_plu'; .*sense_plus"),
    ):
        (tmp_path / "wrong.toml").write_text(text)
        with pytest.raises(ConfigurationError, match=words):
            Instrument.from_name("wrong.toml", tmp_path)


# Meters fitted to flat frames


RIG = FourTerminalMeter(sink=3e-3, sense_plus=8e-4, idle=5e-4, scale=12.0, reads="magnitude")
DRIVES, SENSES = ((0, 3), (3, 0), (1, 4), (5, 2)), ((1, 2), (4, 5), (5, 1), (4, 2))
BOTH = Protocol(
    (
        *(d + s for d in DRIVES for s in SENSES if not set(d) & set(s)),
        *((0, 1, 2, 3), (2, 3, 0, 1), (4, 5, 0, 2), (1, 0, 4, 5)),
        *((2, 4, 0, 5), (4, 2, 3, 1), (0, 5, 1, 3)),
    ),
    6,
)


@pytest.fixture(scope="module")
def skin():
    return random_network()


def flat_frames(meter, skin, noise=0.0, seed=0, count=40):
    """Frames with white noise of this share of the largest reading."""
    true, _ = meter.reading(meter.transfer_impedance(skin, BOTH))
    rng = np.random.default_rng(seed)
    scatter = rng.standard_normal((2, count, len(BOTH))) * noise * np.abs(true).max()
    return true + scatter[0] + (1j * scatter[1] if meter.reads == "complex" else 0.0)


@pytest.mark.slow
def test_loads_of_magnitudes_and_phases_of_complex_readings_are_found(skin):
    terms = ("sink", "sense_plus", "idle")
    found = fit_meter(skin, BOTH, flat_frames(RIG, skin, 1e-3), terms, starts=4)
    assert found.meter.reads == "magnitude"
    true = np.array([3e-3, 8e-4, 5e-4])
    assert (np.abs(found.values - true) < 4.0 * found.standard_errors).all()
    assert (found.standard_errors < 0.02 * true).all()
    assert found.meter.scale == pytest.approx(12.0, abs=4.0 * 12.0 * found.scale_error)
    assert not found.tied
    ideal = fit_meter(skin, BOTH, flat_frames(RIG, skin), ())
    assert agreement(found.predicted, found.measured).r > 0.9999
    assert agreement(ideal.predicted, ideal.measured).residual > 0.05
    rig = FourTerminalMeter(sink=2e-3 + 1e-3j, idle=4e-4j, scale=2.0 * np.exp(0.4j))
    frames = flat_frames(rig, skin, 1e-6)
    found = fit_meter(skin, BOTH, frames, ("sink", "idle"), starts=4).meter
    assert found.sink == pytest.approx(rig.sink, rel=0.02)
    assert found.idle == pytest.approx(rig.idle, rel=0.02)
    assert found.scale == pytest.approx(rig.scale, rel=0.01)


@pytest.mark.slow
def test_leads_leaks_and_offset_are_found_and_what_frames_do_not_call_for_left_out(skin):
    rig = dataclasses.replace(
        RIG, reads="signed", common_mode=0.4, offset=30.0, leaks=(1e-3, 0, 0, 2e-3, 0, 0)
    )
    frames = flat_frames(rig, skin, 1e-6)
    found = fit_meter(skin, BOTH, frames, ("leaks", "common_mode", "offset", "sink"), starts=2)
    assert found.meter.leaks[3] > found.meter.leaks[0] > max(found.meter.leaks[1:3])
    exact = dataclasses.replace(rig, sense_plus=0.0, idle=0.0)
    found = fit_meter(
        skin, BOTH, flat_frames(exact, skin), ("leaks", "common_mode", "offset", "sink"), starts=3
    ).meter
    assert found.leaks == pytest.approx(exact.leaks, abs=1e-5)
    assert (found.common_mode, found.offset, found.scale) == pytest.approx((0.4, 30.0, 12.0), 1e-3)
    terms = ("sink", "sense_plus", "idle", "common_mode")
    rig = dataclasses.replace(RIG, sense_plus=0.0, reads="signed")
    found = select_meter(skin, BOTH, flat_frames(rig, skin, 1e-4), terms, starts=2)
    assert {"sink", "idle"} <= {str(each) for each in found.parameters}
    assert len(found.parameters) < len(terms)
    assert found.meter.sink == pytest.approx(3e-3, rel=0.3)
    assert np.isfinite(found.standard_errors).all()


def test_what_no_reading_shows_is_said_and_frames_that_do_not_fit_refused(skin):
    # A current through two loads has no other way back: only their sum in series shows.
    rig = FourTerminalMeter(sink=2e-3, sense_minus=1e-3, scale=5.0, reads="signed")
    found = fit_meter(skin, BOTH, flat_frames(rig, skin, 1e-5), ("sink", "sense_minus"), starts=2)
    assert not np.isfinite(found.standard_errors).any()
    assert found.tied == (("sink", "sense_minus"),)
    assert (1.0 / found.values).sum() == pytest.approx(1500.0, rel=0.01)
    # One load alone has none, but says where ground is.
    frames = flat_frames(FourTerminalMeter(scale=5.0, reads="signed"), skin, 1e-4)
    found = fit_meter(skin, BOTH, frames, ("sink", "common_mode"), starts=2)
    assert np.isfinite(found.standard_errors).tolist() == [False, True]
    frames = flat_frames(RIG, skin)
    with pytest.raises(ConfigurationError, match=r"among .*source.*, got souce"):
        fit_meter(skin, BOTH, frames, ("souce",))
    with pytest.raises(ConfigurationError, match=r"parameters cannot be fitted to \d+ readings"):
        fit_meter(skin, BOTH, frames, FIT_PARAMETERS)
    with pytest.raises(DataError, match=r"channels, got shape"):
        fit_meter(skin, BOTH, frames[:, 1:])
    with pytest.raises(DataError, match="finite"):
        fit_meter(skin, BOTH, np.where(frames > 0, np.nan, frames))
    with pytest.raises(DataError, match="zero"):
        fit_meter(skin, BOTH, 0.0 * frames)


@pytest.mark.parametrize(("transform", "scale"), [("factor", 1.0), ("linear", 3.0), ("share", 9.0)])
def test_coordinates_are_those_of_the_numbers_and_slopes_their_derivatives(transform, scale):
    parameter = Parameter("sink", 2.0, 0.3, transform, scale=scale)
    for x in (-0.5, 0.2, 1.5):
        assert parameter.coordinate(parameter.number(x)) == pytest.approx(x, rel=1e-12)
        rise = parameter.number(x + 1e-5) - parameter.number(x - 1e-5)
        assert parameter.slope(x) == pytest.approx(rise / 2e-5, rel=1e-7)
