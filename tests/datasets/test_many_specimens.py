"""Sets of many specimens: what a shard solves and holds, and which tables are needed."""

import dataclasses

import numpy as np
import pytest

from eitskin.datasets import Recipe, generate, read_shard
from eitskin.datasets.generation import preparation
from eitskin.datasets.generation.preparation import deciding_specimens
from eitskin.datasets.recipe.frame_sampling import sample, specimen
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.datasets.recipe.specimen import Specimens
from eitskin.datasets.store.shard import shard_name
from eitskin.simulator import Scene, Simulator

from shards_here import in_this_process

MANY = Recipe(
    "many specimens",
    seed=4,
    frames_per_shard=6,
    specimens=Specimens(count=400, conductivity=0.05, thickness=0.02, gel_modulus=0.1),
    scenes=(SceneGroup("bend", count=1200, angle_deg=(-20.0, 30.0)),),
)


def test_a_shard_solves_and_holds_only_its_own_specimens(tmp_path, monkeypatch):
    flat, prepared = [], []
    measure_all, bend_problems = Simulator.measure_all, preparation.bend_problems

    def measuring(self, scenes, *arguments, **options):
        flat.append(scenes == [Scene()])
        return measure_all(self, scenes, *arguments, **options)

    def preparing(*clamped):
        prepared.append(clamped)
        return bend_problems(*clamped)

    monkeypatch.setattr(Simulator, "measure_all", measuring)
    monkeypatch.setattr(preparation, "bend_problems", preparing)
    in_this_process(monkeypatch)
    assert generate(MANY, tmp_path / "set", shard=150) is None
    data = read_shard(tmp_path / "set" / shard_name(150))
    assert data.specimen_number.tolist() == [300, 301]
    assert sum(flat) == len(prepared) == 2
    assert data.specimen.tolist() == [0, 0, 0, 1, 1, 1]
    numbers = data.specimen_number[data.specimen].tolist()
    assert numbers == [sample(MANY, index).specimen for index in MANY.shard_range(150)]
    assert len(np.unique(data.reference, axis=0)) == 2


@pytest.mark.slow
def test_few_specimens_decide_for_many_which_tables_are_needed():
    few = dataclasses.replace(MANY, specimens=dataclasses.replace(MANY.specimens, count=2))
    assert deciding_specimens(few) == (0, 1)
    chosen = deciding_specimens(MANY)
    assert len(chosen) <= 48
    made = [specimen(MANY, number) for number in range(400)]
    thickness = [each.design.thickness for each in made]
    modulus = [each.mechanics.gel.shear_modulus for each in made]
    for values in (thickness, modulus):
        assert {int(np.argmin(values)), int(np.argmax(values))} <= set(chosen)
    wider = dataclasses.replace(MANY, specimens=dataclasses.replace(MANY.specimens, count=1000))
    assert len(deciding_specimens(wider)) <= 48
