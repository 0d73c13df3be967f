"""Grids of solved sensors: in files of old and new form, and in old arguments."""

import pytest

from eitskin.config import to_toml
from eitskin.datasets import Recipe
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.errors import ConfigurationError
from eitskin.geometry import Clamp, SensorDesign
from eitskin.simulator import Mechanics, SensorGrid
from eitskin.simulator.deformation.sensor_grid import read_fixed

GRID = SensorGrid(0.005, 1.4, 0.04, 0.008)


def test_files_of_version_02_are_read_with_their_grid(tmp_path) -> None:
    fixture, mechanics = tmp_path / "fixture.toml", tmp_path / "mechanics.toml"
    fixture.write_text("span = 0.041\nsolved_span = 0.04\nsolved_offset = 0.008\n")
    mechanics.write_text("margin = 0.004\nsolved_thickness = 0.005\nsolved_ratio = 1.4\n")
    assert read_fixed(fixture, mechanics) == (Clamp(0.041), Mechanics(margin=0.004), GRID)
    assert read_fixed(None, None) == (Clamp(), Mechanics(), SensorGrid())
    mechanics.write_text(f"{to_toml(Mechanics())}\n[grid]\n{to_toml(GRID)}")
    assert read_fixed(None, mechanics) == (Clamp(), Mechanics(), GRID)
    mechanics.write_text("[grid]\nratio = 0.0\n")
    with pytest.raises(ConfigurationError, match="ratio"):
        read_fixed(None, mechanics)


def test_recipes_of_version_02_are_read_with_their_grid(tmp_path) -> None:
    path = tmp_path / "old.toml"
    path.write_text(
        'name = "old"\nscenes = [{ state = "idle", count = 1 }]\n'
        "[fixture]\nspan = 0.041\nsolved_span = 0.04\n[mechanics]\nsolved_thickness = 0.005\n"
    )
    recipe = Recipe.from_toml(path)
    assert recipe.grid == SensorGrid(thickness=0.005, span=0.04)
    made = recipe.nominal(0)
    assert made.fixture == Clamp(0.041)
    assert made.grid == SensorGrid(0.005, 1.4, 0.04, 0.008)
    path.write_text(recipe.to_toml())
    assert Recipe.from_toml(path) == recipe


def test_specimens_are_solved_about_the_sensor_of_their_recipe() -> None:
    recipe = Recipe("own", (SceneGroup("idle", count=1),))
    assert recipe.nominal(0).grid == SensorGrid.from_nominal(
        SensorDesign.reference(), Clamp(), Mechanics()
    )


def test_old_arguments_warn() -> None:
    with pytest.warns(DeprecationWarning, match="SensorGrid"):
        assert Mechanics(solved_thickness=0.005) == Mechanics()
    with pytest.warns(DeprecationWarning, match="SensorGrid"):
        assert Clamp(solved_span=0.04) == Clamp()
