"""The four-terminal meter: its circuit against networks solved by hand, then its readings."""

import dataclasses

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.simulator import FourTerminalMeter, Instrument, Protocol, Status

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


def chain(*resistances):
    """Impedance matrix of electrodes in a row, with these resistances between neighbours."""
    links = {(k, k + 1): 1.0 / r for k, r in enumerate(resistances)}
    return impedance(links, len(resistances) + 1)


def random_network(n=6):
    rng = np.random.default_rng(1)
    links = {(i, j): rng.uniform(1e-3, 5e-3) for i in range(n) for j in range(i)}
    return impedance(links, n)


def sensed(meter, Z, protocol=FOUR):
    return meter.transfer_impedance(Z, protocol)


# ---- closed forms ----


def test_every_load_and_leak_is_a_conductance_to_ground_of_a_nodal_network():
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


def test_leads_are_in_series_with_their_electrodes_on_the_sensors_side_of_the_loads():
    R, lead, y = 500.0, 60.0, 1e-3
    two = Protocol.pairwise(2)
    meter = FourTerminalMeter(leads=(lead, 0.0), source=y, sink=y)
    expected = 1.0 / (1.0 / (R + lead) + y / 2.0)
    assert sensed(meter, chain(R), two) == pytest.approx(expected, rel=1e-12)


def test_a_loaded_drive_pair_has_its_leads_and_loads():
    """Two electrodes, one resistor: the source sees it between its leads, both loads beside it."""
    meter = FourTerminalMeter(source=2e-3, sink=1e-3, leads=(5.0, 7.0))
    R = 100.0
    matrix = R / 4 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    both = meter.terminal_impedances(matrix, Protocol(((0, 1, 0, 1),), 2))
    through_ground = 1 / 2e-3 + 1 / 1e-3
    expected = 1 / (1 / (R + 12.0) + 1 / through_ground)
    assert both[1, 0] == pytest.approx(expected, rel=1e-12)


# ---- invariants ----


def test_without_loads_and_leaks_the_meter_is_ideal():
    Z = random_network()
    ideal = RING.measure(Z)
    np.testing.assert_array_equal(sensed(FourTerminalMeter(scale=3.0), Z, RING), ideal)
    assert not FourTerminalMeter(scale=3.0, offset=1.0, step=0.1).is_loaded
    least = FourTerminalMeter(*5 * (1e-12,), leads=6 * (1e-9,))
    assert sensed(least, Z, RING) == pytest.approx(ideal, rel=1e-6)
    # Leads carry no current where only they are there: four terminals do not see them.
    assert sensed(FourTerminalMeter(leads=6 * (80.0,)), Z, RING) == pytest.approx(ideal, rel=1e-9)


# ---- readings ----


def test_readings_are_scaled_offset_limited_and_rounded_in_this_order():
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


def test_a_board_may_read_signed_values_or_magnitudes():
    voltage = np.array([-3.0 + 4.0j, 2.0 - 1.0j])
    for reads, expected in (("signed", [-3, 2]), ("magnitude", [5, np.sqrt(5)])):
        assert FourTerminalMeter(reads=reads).reading(voltage)[0] == pytest.approx(expected)


def test_a_session_reads_by_its_meter_and_flags_what_saturates():
    meter = FourTerminalMeter(scale=-0.5, saturation=20.0, reads="magnitude")
    board = dataclasses.replace(Instrument.ideal(), meter=meter)
    rng = np.random.default_rng(0)
    session = board.session(Protocol.pairwise(3), 100.0, rng)
    (read,), (status,) = session.measure(np.array([[10.0, 30.0, 60.0 + 0j]]), np.zeros(1), rng)
    assert read == pytest.approx([5.0, 15.0, 20.0])
    assert status.tolist() == [0, 0, Status.CLIPPED]


# ---- refusals and files ----


@pytest.mark.parametrize(
    ("terms", "message"),
    [
        ({"source": -1e-3}, r"source.*0 to 1000 S"),
        ({"leaks": (0.0, float("nan"))}, r"leaks\[1\]"),
        ({"leads": (-1.0,)}, r"leads\[0\].*ohm"),
        ({"scale": 0.0}, "scales"),
        ({"offset": float("inf")}, "finite"),
        ({"saturation": -1.0, "source": -1.0}, "source.*saturation"),
    ],
)
def test_impossible_terms_are_refused_together(terms, message):
    with pytest.raises(ConfigurationError, match=message):
        FourTerminalMeter(**terms)


def test_a_meter_of_another_sensor_or_protocol_is_refused():
    meter = FourTerminalMeter(leaks=(0.0, 1e-6))
    with pytest.raises(ConfigurationError, match=r"leaks.*4 electrodes, got 2"):
        sensed(meter, chain(1.0, 1.0, 1.0))
    board = Instrument(meter=FourTerminalMeter(channel_scale=(1.0, 2.0)))
    with pytest.raises(ConfigurationError, match=r"channel_scale.*3 measurements, got 2"):
        board.session(Protocol.pairwise(3), 1.0, np.random.default_rng(0))


def test_instrument_files_are_read_back_and_named_by_their_path(tmp_path):
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
