"""Boards of specimens: loads that differ as asked for, in frames and references of each."""

import dataclasses

import numpy as np

from eitskin.datasets import Recipe
from eitskin.datasets.generation.shard_simulation import simulate_frames
from eitskin.datasets.recipe.frame_sampling import instrument, specimen
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.datasets.recipe.specimen import MAX_DEVIATIONS, Specimens
from eitskin.simulator import FourTerminalMeter, Instrument

TERMS = ("source", "sink", "sense_plus", "sense_minus", "idle", "common_mode")
METER = FourTerminalMeter(2e-5, 1e-5, 3e-5, 1e-5, 2e-5, common_mode=0.003, scale=2.0)


def recipe(loads, count=3, meter=METER) -> Recipe:
    return Recipe(
        "boards",
        scenes=(SceneGroup("idle", count=count),),
        seed=3,
        instrument=Instrument(snr_db=0.0, gain=0.002, meter=meter),
        specimens=Specimens(count, conductivity=0.2, board_loads=loads),
        resolution="coarse",
    )


def test_every_load_has_the_spread_that_was_asked_for():
    asked = recipe(3.0, 400)
    meters = [instrument(asked, number).meter for number in range(400)]
    ratios = np.log([[getattr(m, t) / getattr(METER, t) for t in TERMS] for m in meters])
    sd = np.sqrt(np.log1p(3.0**2))  # of a lognormal factor
    np.testing.assert_allclose(ratios.std(axis=0), 0.986 * sd, rtol=4 / np.sqrt(800))
    assert np.abs(ratios.mean(axis=0)).max() < 4 * sd / np.sqrt(400)
    assert np.abs(ratios).max() <= MAX_DEVIATIONS * sd * (1 + 1e-9)
    apart = np.corrcoef(ratios.T) - np.eye(len(TERMS))
    assert np.abs(apart).max() < 0.2
    assert {each.scale for each in meters} == {2.0}


def test_boards_leave_the_sensors_as_they_are():
    loaded, same = recipe(3.0), recipe(0.0)
    for number in range(3):
        assert specimen(loaded, number) == specimen(same, number)
        assert instrument(same, number) == same.instrument


def test_frames_and_references_of_a_specimen_are_read_by_its_own_board():
    asked = recipe(3.0)
    data = simulate_frames(asked, range(3))
    for row, number in enumerate(data.specimen_number[data.specimen].tolist()):
        own = dataclasses.replace(
            asked,
            instrument=instrument(asked, number),
            specimens=dataclasses.replace(asked.specimens, board_loads=0.0),
        )
        alone = simulate_frames(own, [int(data.number[row])])
        np.testing.assert_array_equal(data.impedance[row], alone.impedance[0])
        np.testing.assert_array_equal(data.reference[data.specimen[row]], alone.reference[0])
    usual = simulate_frames(recipe(0.0), range(3))
    assert np.abs(data.impedance / usual.impedance - 1.0).max() > 1e-3
