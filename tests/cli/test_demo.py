"""The demo: one report, whole in itself, and the same after every interruption."""

import json
import re
import shutil
from html.parser import HTMLParser
from importlib import import_module
from itertools import count

import msgspec
import pytest
from rich.console import Console

from eitskin.cli.demo import command as demo
from eitskin.cli.demo import pictures, stages
from eitskin.cli.demo.command import marked_number, run_demo
from eitskin.cli.demo.stages import SETS, STAGES, Demo
from eitskin.cli.options import Output
from eitskin.datasets import Recipe
from eitskin.datasets.generation import generate as generation
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.errors import ConfigurationError, PartialError
from eitskin.training import Report
from eitskin.training.evaluation.report import table_rows

from shards_here import make_shards

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
    drawn, rendered = count(), pictures.rendered

    def quick(_, *texts):
        return rendered(lambda path: shutil.copyfile("docs/live-page.png", path), *texts)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pictures, "_svg", lambda _: f"<svg>{next(drawn)}</svg>".encode())
        patch.setattr(stages, "rendered", quick)
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


class Page(HTMLParser):
    """Contents and references of a page."""

    def __init__(self, text):
        super().__init__()
        self.references, self.images, self.marked, self.rows = [], [], [], []
        self.style, self.open, self.folded = "", [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        if tag not in ("meta", "img"):
            self.open.append(tag)
        self.references += [given[name] for name in ("src", "href", "srcset") if name in given]
        if tag == "img":
            self.images.append(given)
            self.folded.append("details" in self.open)
        if tag == "data":
            self.marked.append((given["data-from"], given["value"]))
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "style":
            self.style += data
        elif self.rows and {"td", "th"} & set(self.open):
            self.rows[-1][-1] += data


@pytest.fixture(scope="module")
def report(finished):
    return Page((finished / "report.html").read_text())


@pytest.mark.slow
def test_the_report_refers_to_nothing_outside_itself(finished, report):
    assert all(each.startswith("data:image/") for each in report.references)
    assert not re.search(r"url\(|@import", report.style)
    text = re.sub(r'src="data:[^"]*"', "", (finished / "report.html").read_text())
    assert not re.search(r"<(script|link|iframe|object|embed|base)\b|\bon\w+=", text)
    assert not re.search(r"https?:", text)
    assert not report.open


@pytest.mark.slow
def test_every_picture_of_a_stage_is_shown_once_with_a_text(report):
    assert len(report.images) >= 13
    assert report.folded == [False] * 6 + [True] * (len(report.images) - 6)  # the film, and five
    assert all(len(image["alt"]) > 10 for image in report.images)
    shown = [image["src"] for image in report.images]
    assert all(shown.count(source) == 1 for source in shown if "image/svg" in source)


@pytest.mark.slow
def test_the_numbers_shown_are_those_of_the_document(finished, report):
    document = json.loads((finished / "report.json").read_text())
    assert len(report.marked) > 60
    for path, shown in report.marked:
        value = document
        for key in path.split("."):
            value = value[int(key)] if isinstance(value, list) else value[key]
        assert str(value) == shown, path
    for stage, column in (("test", 2), ("shipped", 3)):
        for name, _, here in table_rows(msgspec.convert(document[stage], Report)):
            shown = [name.strip(), here.replace("+-", "±")]
            assert any([row[0], row[column]] == shown for row in report.rows if row[3:])


def test_a_number_that_is_not_known_is_shown_as_none():
    assert "none" in marked_number({"a": [{"b": None}]}, "a.0.b", ".1f")


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_pipeline_that_was_removed_or_trained_otherwise_is_trained_again(finished, tmp_path):
    folder = shutil.copytree(finished, tmp_path / "demo")
    assert space(folder).is_trained()
    assert not space(folder, epochs=2).is_trained()
    shutil.rmtree(folder / "demo.eitmodel")
    assert not space(folder).is_trained()


@pytest.mark.slow
def test_text_of_files_is_escaped(finished, tmp_path):
    folder = shutil.copytree(finished, tmp_path / "demo")
    run(folder, data=tmp_path / "<b>&recordings")
    page = (folder / "report.html").read_text()
    assert "<b>&" not in page
    assert "&lt;b&gt;&amp;recordings" in page


def test_a_folder_that_cannot_be_used_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigurationError):
        space(tmp_path / "file")


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


def test_missing_packages_are_named_before_anything_is_made(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == "jinja2" else 1)
    with pytest.raises(ImportError, match=r"jinja2.*eitskin\[demo\]"):
        demo.command(out=tmp_path / "demo")
    assert not (tmp_path / "demo").exists()
