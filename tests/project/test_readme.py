"""One thread through the whole system, small: recipe, frames, pipeline, board, and the README."""

import re
from pathlib import Path

import numpy as np
import pytest

from eitskin.config import parse_toml
from eitskin.datasets import Recipe, State, open_dataset
from eitskin.geometry import Bend
from eitskin.hardware import Script, Step, open_board, run_live
from eitskin.simulator import Scene
from eitskin.training import NetworkSettings, Pipeline, TrainingSettings

from shards_here import made_here

README = Path(__file__).resolve().parents[2] / "README.md"
RECIPE = """
name = "small"
frames_per_shard = 30

[[scenes]]
state = "idle"
count = 30

[[scenes]]
state = "bend"
count = 30
angle_deg = [-20, 50]

[[scenes]]
state = "touch"
count = 30
force = [10, 10]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Where the pipeline lies that a small generated dataset was trained on."""
    place = tmp_path_factory.mktemp("thread")
    made_here(parse_toml(Recipe, RECIPE), place / "small")
    brief = NetworkSettings(3e-3, epochs=8, batch=16)
    pipeline = Pipeline.fit(
        open_dataset(place / "small"), TrainingSettings(classifier=brief, postprocessor=brief)
    )
    pipeline.save(place / "build" / "demo" / "demo.eitmodel")
    return place


@pytest.mark.slow
def test_the_saved_pipeline_says_on_a_board_what_it_says_offline(folder) -> None:
    model = folder / "build" / "demo" / "demo.eitmodel"
    script = Script((Step(Scene(), 3), Step(Scene(bend=Bend(40.0)), 3)))
    with open_board("virtual:", scene=script, speed="max", seed=5) as board:
        readings = []
        for reading in run_live(board, Pipeline.load(model), newest=False):
            readings.append(reading)
            if len(readings) == 6:
                break
    offline = Pipeline.load(model)
    for reading in readings:
        again = offline.process(reading.frame)
        assert np.array_equal(again.probabilities, reading.estimate.probabilities)
        assert again.bend_angle_deg == reading.estimate.bend_angle_deg
    angles = [reading.estimate.bend_angle_deg for reading in readings]
    assert angles[:3] == pytest.approx([0.0] * 3, abs=5.0)
    assert angles[3:] == pytest.approx([40.0] * 3, abs=10.0)


@pytest.mark.slow
def test_the_example_in_the_readme_finds_the_touch_that_it_simulates(capsys) -> None:
    page = README.read_text()
    (example,) = re.findall(r"```python\n(.*?)```\n", page, re.DOTALL)
    scope: dict[str, object] = {}
    exec(compile(example, str(README), "exec"), scope)  # noqa: S102
    estimate, scene = scope["estimate"], scope["scene"]
    (touch,) = scene.touches
    assert estimate.state is State.TOUCH
    assert estimate.bend_angle_deg == pytest.approx(scene.bend.angle_deg, abs=1.0)
    (found,) = estimate.touches
    assert found[:2] == pytest.approx((touch.x, touch.y), abs=3e-3)
    shown = capsys.readouterr().out
    assert f"```text\n{shown}```" in page, "the page shows what the example prints"
