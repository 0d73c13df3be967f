"""The demo: one report, whole in itself, and the same after every interruption."""

import html
import io
import json
import re
import shutil
from importlib import import_module
from itertools import count

import msgspec
import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from eitskin.cli.demo import command as demo
from eitskin.cli.demo import pictures, stages
from eitskin.cli.demo.command import run_demo
from eitskin.cli.demo.stages import SETS, STAGES, Demo
from eitskin.cli.options import Output
from eitskin.datasets import Recipe
from eitskin.datasets.generation import generate as generation
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.errors import PartialError
from eitskin.geometry import SensorDesign
from eitskin.training import Report
from eitskin.training.evaluation.report import table_rows

from shards_here import make_shards

pytestmark = pytest.mark.slow

TIMES = re.compile("seconds|date|latency|latencies|_ms$")


def tiny_recipes():
    def touches(count, **more):
        return SceneGroup("touch", count, force=(8.0, 12.0), **more)

    def recipe(name, scenes, seed):
        return Recipe(name, scenes, seed=seed, frames_per_shard=200)

    lessons = (
        SceneGroup("idle", 10),
        SceneGroup("bend", 10, angle_deg=(-20.0, 50.0)),
        touches(10, touches=(1, 4)),
        touches(8, angle_deg=(-20.0, 50.0), touches=(1, 4), per_bend=4),
    )
    tests = (
        SceneGroup("idle", 4),
        SceneGroup("bend", 4, angle_deg=(-20.0, 50.0)),
        touches(4, touches=(1, 1)),
        touches(4, angle_deg=(25.0, 30.0), touches=(2, 2), per_bend=4),
    )
    positions = ((0.03, 0.03), (0.075, 0.03), (0.12, 0.03))
    grid = (SceneGroup("touch", force=(10.0, 10.0), repeats=2, positions=positions),)
    scenes = zip(SETS, (lessons, tests, grid), strict=True)
    return {name: recipe(name, each, n) for n, (name, each) in enumerate(scenes, 1)}


class Interrupted(Output):
    """Raises KeyboardInterrupt when a stage begins."""

    def __init__(self, at=None):
        super().__init__(quiet=True, console=Console(quiet=True), notes=Console(quiet=True))
        self.at, self.begun = at, 0

    def heading(self, text):  # noqa: ARG002
        if self.begun == self.at:
            raise KeyboardInterrupt
        self.begun += 1


def space(folder, at=None, data=None, epochs=1):
    recipes = tiny_recipes()
    return Demo(folder, data, 1, Interrupted(at), 0, recipes, epochs, episode_frames=1)


def run(folder, at=None, data=None):
    return run_demo(space(folder, at, data), ["eitskin", "demo"])


@pytest.fixture(scope="module", autouse=True)
def quickly():
    """Leave out what has tests of its own and takes seconds: pictures, and processes."""
    drawn, rendered = count(), pictures.render_picture

    def quick(_, *texts):
        return rendered(lambda path: shutil.copyfile("docs/gallery/live_page.png", path), *texts)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pictures, "_svg", lambda _: f"<svg>{next(drawn)}</svg>".encode())
        patch.setattr(stages, "render_picture", quick)
        patch.setattr(stages, "episode_film", lambda *_: b"film")
        patch.setattr(generation, "make_shards", make_shards)
        yield


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo") / "uninterrupted"
    run(folder)
    return folder


def untimed(value):
    """Numbers without times and dates, which differ from run to run."""
    if isinstance(value, dict):
        return {key: untimed(each) for key, each in value.items() if not TIMES.search(key)}
    return [untimed(each) for each in value] if isinstance(value, list) else value


def numbers(folder):
    return untimed(json.loads((folder / "report.json").read_text()))


def test_the_report_is_whole_in_itself_and_shows_the_numbers_of_the_document(finished):
    text = (finished / "report.html").read_text()
    addresses = re.findall(r'\b(?:src|href|srcset)="([^"]*)"', text)
    assert len(addresses) >= 13
    assert all(each.startswith(("data:image/", "#")) for each in addresses)
    text = re.sub(r'src="data:[^"]*"', "", text)
    outside = r"url\(|@import|<(script|link|iframe|object|embed|base)\b|\bon\w+=|https?:"
    assert not re.search(outside, text)
    document = json.loads((finished / "report.json").read_text())
    marked = re.findall(r'<data value="([^"]*)" data-from="([^"]*)">', text)
    assert len(marked) > 60
    for shown, path in marked:
        value = document
        for key in path.split("."):
            value = value[int(key)] if isinstance(value, list) else value[key]
        assert str(value) == html.unescape(shown), path
    cells = re.compile(r"<t[dh][^>]*>(.*?)</t[dh]>", re.DOTALL)
    rows = [
        [html.unescape(re.sub("<[^>]*>", "", cell)) for cell in cells.findall(row)]
        for row in re.findall(r"<tr.*?</tr>", text, re.DOTALL)
    ]
    for stage, column in (("test", 2), ("shipped", 3)):
        for name, _, here in table_rows(msgspec.convert(document[stage], Report)):
            shown = [name.strip(), here.replace("+-", "±")]
            assert any([row[0], row[column]] == shown for row in rows if row[3:])


def test_a_demo_that_was_interrupted_goes_on_to_the_same_report(finished, tmp_path, monkeypatch):
    generate = import_module("eitskin.datasets.generation.generate")  # a function hides the module
    monkeypatch.setattr(generate, "prepare", lambda *_, **__: None)
    for stage in (list(STAGES).index("training"), len(STAGES) - 1):
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path, at=stage)
        assert not (tmp_path / "report.html").exists()
    monkeypatch.setattr(stages, "train_and_measure", None)  # nothing is made twice
    run(tmp_path)
    assert numbers(tmp_path) == numbers(finished)
    assert not list(tmp_path.rglob(".*"))


def test_text_of_files_is_escaped(finished, tmp_path):
    """And a pipeline that was removed, or trained otherwise, is trained again."""
    folder = shutil.copytree(finished, tmp_path / "<script>")
    assert space(folder).is_trained()
    assert not space(folder, epochs=2).is_trained()
    run(folder, data=tmp_path / "<b>&recordings")
    page = (folder / "report.html").read_text()
    assert not re.search("<b>&|<script", page)
    assert "&lt;b&gt;&amp;recordings" in page
    assert "&lt;script&gt;/demo.eitmodel" in page
    shutil.rmtree(folder / "demo.eitmodel")
    assert not space(folder).is_trained()


@pytest.mark.parametrize("cause", [KeyboardInterrupt, PartialError])
def test_a_demo_that_was_stopped_names_the_command_that_goes_on(
    cause, tmp_path, monkeypatch, capsys
):
    def stop(*_):
        raise cause

    monkeypatch.setattr(demo, "run_demo", stop)
    with pytest.raises(cause):
        demo.command(out=tmp_path / "a b", workers=5, seed=3)
    assert f"eitskin demo --out '{tmp_path}/a b' --workers 5 --seed 3\n" in capsys.readouterr().err


def test_the_film_has_every_moment_and_begins_with_the_fullest():
    places = [[40.0, 20.0], [110.0, 40.0]]
    rows = [
        {
            "states": [state] * 2,
            "angles_deg": [angle] * 2,
            "true_angle_deg": 20.0,
            "found_mm": [places[:count]] * 2,
            "true_touches_mm": places[:count],
        }
        for state, angle, count in (("idle", 0.0, 0), ("touch", 20.0, 2), ("bend", np.nan, 1))
    ]
    film = Image.open(io.BytesIO(pictures.episode_film(rows, SensorDesign.reference())))
    assert film.n_frames == 6
    first = np.asarray(film.convert("RGB"))
    film.seek(4)
    assert np.abs(first - np.asarray(film.convert("RGB")).astype(float)).max() > 100
