"""Checks of readings without a model: silent for ideal meters, in words for others."""

import dataclasses
import json

import numpy as np
import pytest
from command_line import run

from eitskin.datasets import Dataset, save_dataset
from eitskin.errors import ConfigurationError, DataError
from eitskin.hardware.diagnosis.checked_frames import FindingKind
from eitskin.hardware.diagnosis.reading_check import (
    LAWS,
    check_readings,
    linear_relations,
)
from eitskin.simulator import FourTerminalMeter, Protocol, Status

RNG = np.random.default_rng(1)
MIXED = RNG.normal(size=(3, 8, 8))
SKINS = MIXED @ MIXED.swapaxes(1, 2)
SHARED = Protocol.adjacent(8, shared=True)
OPPOSITE = Protocol(
    tuple((k, (k + 4) % 8, (k + s + 1) % 8, (k + s) % 8) for k in range(8) for s in (1, 2, 5, 6)),
    8,
)


def frames(protocol, meter=None, count=40, noise=1e-4):
    """Readings of a sensor that is pressed anew for each frame."""
    rng = np.random.default_rng(0)
    Z = SKINS[0] + 0.02 * rng.uniform(size=(count, 1, 1)) * SKINS[rng.integers(1, 3, size=count)]
    meter = meter or FourTerminalMeter()
    values, _ = meter.reading(meter.transfer_impedance(Z, protocol))
    scatter = noise * np.abs(values).max() * rng.standard_normal(values.shape)
    return np.abs(values + scatter) if meter.reads == "magnitude" else values + scatter


def kinds(result):
    return [each.what for each in result.findings]


# ---- relations ----


@pytest.mark.parametrize(
    ("protocol", "counts"),
    [
        (Protocol.pairwise(8), (0, 0, 0, 0)),
        (Protocol.adjacent(8), (0, 0, 20, 0)),
        (SHARED, (0, 0, 28, 16)),  # a loop around the rim for each drive, and for each sense pair
        (Protocol.opposite(8), (0, 0, 0, 0)),
        (OPPOSITE, (16, 0, 0, 0)),
        (Protocol(((0, 1, 2, 3), (0, 1, 3, 2), (1, 0, 3, 2)), 4), (1, 1, 0, 0)),
        (Protocol(((0, 1, 0, 1), (0, 1, 1, 2), (0, 1, 2, 0)), 3), (0, 0, 0, 1)),
    ],
)
def test_the_table_says_which_relations_there_are_and_every_sensor_obeys_them(protocol, counts):
    relations = linear_relations(protocol)
    assert tuple(sum(r.kind == kind for r in relations) for kind in LAWS) == counts
    n = protocol.n_electrodes
    readings = protocol.measure(SKINS[:, :n, :n])
    for each in relations:
        assert readings[:, each.channels] @ np.array(each.signs) == pytest.approx(0.0, abs=1e-9)


# ---- boards ----


@pytest.mark.parametrize("protocol", [Protocol.pairwise(8), SHARED, OPPOSITE])
@pytest.mark.parametrize("reads", ["complex", "signed", "magnitude"])
def test_ideal_meters_are_healthy(protocol, reads):
    meter = FourTerminalMeter(reads=reads, scale=-0.3, leads=8 * (0.5,))
    alone = dataclasses.replace(meter, leads=())
    for each in (meter, alone):
        assert check_readings(frames(protocol, each), protocol).healthy


def test_loads_break_reciprocity_and_are_told_by_swapped_drives():
    meter = FourTerminalMeter(sink=0.2, idle=0.05, sense_plus=0.1, reads="magnitude")
    result = check_readings(frames(OPPOSITE, meter), OPPOSITE)
    assert kinds(result) == [FindingKind.DRIVE_SWAP]
    assert "source and sink" in result.findings[0].message
    (law,) = result.laws
    assert law.relations == 16
    assert law.violated > 8
    assert law.largest > law.median > 0.05
    loaded = FourTerminalMeter(sink=0.2, idle=0.05)
    assert kinds(check_readings(frames(SHARED, loaded), SHARED))[0] == FindingKind.RECIPROCITY
    gains = FourTerminalMeter(channel_scale=tuple(RNG.uniform(0.7, 1.3, len(SHARED))))
    expected = [FindingKind.RECIPROCITY, FindingKind.LOOP]
    assert kinds(check_readings(frames(SHARED, gains), SHARED)) == expected


def test_wrong_dead_stuck_and_clipped_channels_are_named_and_noise_is_none():
    values = frames(SHARED)
    values[:, 5] *= 1.5
    result = check_readings(values, SHARED)
    reciprocity, loops = result.findings
    assert reciprocity.channels == tuple(sorted((5, SHARED.table.index((5, 6, 0, 1)))))
    assert loops.channels == (5,)
    assert loops.message.endswith(f"check the paths of channel {SHARED.labels[5]}")
    assert kinds(result) == [FindingKind.RECIPROCITY, FindingKind.LOOP]
    values[:, 5] *= -1.0 / 1.5  # a pair of the table the wrong way round
    assert "wrong sign" in check_readings(values, SHARED).findings[0].message
    noisy = frames(SHARED, count=30, noise=0.05)
    laws = check_readings(noisy, SHARED)
    assert laws.healthy
    assert max(law.largest for law in laws.laws) > 0.05
    values = frames(Protocol.opposite(8))
    values[:, 3] = 0.0
    values[:, 7] = values[0, 7]
    values[:, 11] = np.clip(
        values[:, 11].real + np.abs(values).max(), 0, 2.0 * np.abs(values).max()
    )
    top = np.abs(values).max()
    values[::4, 11] = top
    result = check_readings(values, Protocol.opposite(8))
    assert {(each.what, each.channels) for each in result.findings} == {
        (FindingKind.DEAD, (3,)),
        (FindingKind.STUCK, (7,)),
        (FindingKind.CLIPPED, (11,)),
    }
    largest = np.abs(frames(SHARED)).max()
    meter = FourTerminalMeter(saturation=0.4 * largest, step=1e-4 * largest, reads="signed")
    values = frames(SHARED, meter, noise=0.0)
    result = check_readings(values, SHARED)
    limited = (np.abs(values) == np.abs(values).max()).any(axis=0)
    clipped = [each for each in result.findings if each.what == FindingKind.CLIPPED]
    assert {k for each in clipped for k in each.channels} == set(np.flatnonzero(limited))
    assert limited.sum() > 1
    values = frames(SHARED)
    values[3, 2] = np.nan
    status = np.zeros(values.shape, np.uint8)
    status[:, 4] = Status.CLIPPED
    found = check_readings(values, SHARED, status)
    assert kinds(found) == [FindingKind.NOT_FINITE, FindingKind.CLIPPED]


# ---- the command ----


@pytest.mark.slow
def test_the_command_checks_recordings_of_any_protocol(tmp_path):
    meter = FourTerminalMeter(sink=0.2, idle=0.05, sense_plus=0.1, reads="magnitude")
    np.savez(tmp_path / "rig.npz", u=frames(OPPOSITE, meter).real)
    OPPOSITE.to_file(tmp_path / "table.csv")
    options = ("check", "--recording", tmp_path / "rig.npz", "--values", "u", "--protocol")
    said = json.loads(run(*options, tmp_path / "table.csv", "--json", code=4).stdout)
    assert [each["what"] for each in said["findings"]] == ["swapped drives"]
    assert said["laws"][0]["relations"] == 16
    with pytest.raises(DataError):
        run(*options, "adjacent:8")
    folder = tmp_path / "set"
    save_dataset(Dataset.from_arrays(frames(SHARED), protocol=SHARED), folder)
    result = run("check", "--recording", folder, code=0)
    assert "healthy" in result.stdout
    assert "reciprocity: 28 compared" in result.stderr
    for wrong in (("reference.eitmodel", "--recording", folder), ("--values", "u")):
        with pytest.raises(ConfigurationError):
            run("check", *wrong)
