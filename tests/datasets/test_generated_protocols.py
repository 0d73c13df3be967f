"""Generating by any protocol and board: what the recipe names is what is measured."""

import dataclasses

import pytest

from eitskin.config import parse_toml
from eitskin.datasets import Recipe
from eitskin.datasets.generation.shard_simulation import simulate_frames, simulate_shard
from eitskin.datasets.recipe.frame_sampling import specimen
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.errors import ConfigurationError
from eitskin.simulator import FourTerminalMeter, Instrument, Protocol, Simulator


def test_frames_of_a_board_that_is_no_ideal_meter_are_its_readings():
    meter = FourTerminalMeter(sink=2e-3, idle=1e-3, scale=-4.0, step=0.25, reads="magnitude")
    recipe = Recipe(
        "loaded",
        resolution="coarse",
        protocol=Protocol.opposite(8),
        instrument=Instrument(snr_db=0.0, meter=meter),
        scenes=(SceneGroup("idle", count=1),),
    )
    data = simulate_frames(recipe, [0])
    made = specimen(recipe, 0)
    Z = Simulator(made.design, "coarse", made.fixture).model.impedance()
    read, _ = meter.reading(meter.transfer_impedance(Z, recipe.protocol))
    assert data.impedance[0] == pytest.approx(read, abs=0.26)  # a step of rounding
    assert data.reference[0] == pytest.approx(data.impedance[0])
    assert data.quantity == "magnitude"
    assert parse_toml(Recipe, data.recipe).instrument == recipe.instrument
    leaking = Instrument(meter=FourTerminalMeter(leaks=(1e-6,)))
    with pytest.raises(ConfigurationError, match=r"instrument: leaks.*8 electrodes, got 1"):
        dataclasses.replace(recipe, instrument=leaking)


def test_frames_are_measured_by_the_protocol_of_the_recipe():
    plain = Recipe(
        "own",
        scenes=(SceneGroup("idle", count=1),),
        resolution="coarse",
        instrument=Instrument(0.0),
    )
    adjacent = dataclasses.replace(plain, protocol=Protocol.adjacent(8))
    pairs, found = simulate_shard(plain, 0), simulate_shard(adjacent, 0)
    assert found.protocol == Protocol.adjacent(8)
    assert found.reference.shape == found.impedance.shape == (1, 40)
    z = dict(zip(((a, b) for a, b, *_ in pairs.protocol.table), pairs.impedance[0], strict=True))
    # Impedance of pairs, z_ab = Z_aa + Z_bb - 2 Z_ab; four terminals by superposition.
    expected = [
        (
            z[min(a, d), max(a, d)]
            + z[min(b, c), max(b, c)]
            - z[min(a, c), max(a, c)]
            - z[min(b, d), max(b, d)]
        )
        / 2.0
        for a, b, c, d in found.protocol.table
    ]
    assert found.impedance[0] == pytest.approx(expected, abs=1e-3)  # single precision
