"""The demo: interrupted anywhere it goes on to the same numbers, and its report needs nothing."""

import hashlib
import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path

import msgspec
import pytest
from rich.console import Console

from eitskin.cli.demo import (
    command as demo,
)
from eitskin.cli.demo import (
    folder as demo_folder,
)
from eitskin.cli.demo import (
    parts as demo_parts,
)
from eitskin.cli.demo import (
    real_input,
)
from eitskin.cli.demo import (
    sensor as demo_sensor,
)
from eitskin.cli.demo.folder import RESULTS, Demo, Plan
from eitskin.cli.demo.parts import Part, Picture, keep
from eitskin.cli.demo.report import write_demo_report
from eitskin.cli.demo.stages import STAGES, run_stages
from eitskin.cli.options import Output
from eitskin.datasets import Recipe
from eitskin.datasets.generation import process_pool as processes
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.errors import ConfigurationError, DataError, PartialError
from eitskin.training import Report
from eitskin.training.evaluation.report.table import table_rows
from eitskin.training.method.observations import fingerprint

from shards_here import make_shards

TIMES = re.compile("seconds|date|latency|_ms$")
DOT = bytes.fromhex(
    "89504e470d0a1a0a0000000d49484452000000010000000108000000003a7e9b55"
    "0000000a49444154789c636000000002000148afa4710000000049454e44ae426082"
)


def tiny_plan(seed=0):
    def touches(count, **more):
        return SceneGroup("touch", count, force=(8.0, 12.0), **more)

    def recipe(name, scenes, seed):
        return Recipe(name, scenes, seed=seed, frames_per_shard=200)

    lessons = (
        SceneGroup("idle", 20),
        SceneGroup("bend", 25, angle_deg=(-20.0, 50.0)),
        touches(20, touches=(1, 4)),
        touches(10, angle_deg=(-20.0, 50.0), touches=(1, 4)),
    )
    tests = (
        SceneGroup("idle", 6),
        SceneGroup("bend", 8, angle_deg=(-20.0, 50.0)),
        touches(6, touches=(1, 1)),
        touches(6, angle_deg=(25.0, 30.0), touches=(2, 2)),
    )
    places = ((0.03, 0.03), (0.075, 0.03), (0.12, 0.03))
    grid = (SceneGroup("touch", force=(10.0, 10.0), repeats=2, positions=places),)
    recipes = {
        "quick": recipe("quick", lessons, 1 + seed),
        "quick_test": recipe("quick_test", tests, 2 + seed),
        "paper_indentation": recipe("paper_indentation", grid, 3 + seed),
    }
    return Plan(recipes, seed, epochs=1, episode_frames=2)


class Interrupted(Output):
    """Is interrupted when a stage begins."""

    def __init__(self, at=None):
        super().__init__(quiet=True, console=Console(quiet=True), notes=Console(quiet=True))
        self.at, self.begun = at, 0

    def heading(self, text):  # noqa: ARG002
        if self.begun == self.at:
            raise KeyboardInterrupt
        self.begun += 1


def run(folder, at=None, data=None):
    here = Demo(tiny_plan(), folder, data, 1, Interrupted(at))
    return write_demo_report(run_stages(here), here)


def as_they_stand(figure, svg=demo_parts._svg):
    """Figures without room made for their texts, which takes long."""
    figure.set_layout_engine("none")
    return svg(figure)


@pytest.fixture(scope="module", autouse=True)
def quickly():
    """Pictures of pyvista and processes that simulate have tests of their own, and take seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo_parts, "_svg", as_they_stand)
        patch.setattr(demo_sensor, "_rendered", lambda _: DOT)
        patch.setattr(processes, "make_shards", make_shards)
        patch.setattr(demo_folder, "train_pipeline", trained_once())
        yield


def trained_once():
    """Training, done once for the same frames and settings."""
    pipelines, train = {}, demo_folder.train_pipeline

    def get(data, *how):
        key = (fingerprint(data), *how[:-1])
        if key not in pipelines:
            pipelines[key] = train(data, *how)
        return replace(pipelines[key], metrics={**pipelines[key].metrics})

    return get


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo") / "uninterrupted"
    run(folder)
    return folder


def untimed(value):
    """Without what another run measures anew."""
    if isinstance(value, dict):
        return {key: untimed(each) for key, each in value.items() if not TIMES.search(key)}
    return [untimed(each) for each in value] if isinstance(value, list) else value


def numbers(folder):
    document = json.loads((folder / "report.json").read_text())
    document["provenance"].pop("command")  # it names the folder
    return untimed(document)


class Page(HTMLParser):
    """What a page shows and refers to."""

    def __init__(self, text):
        super().__init__()
        self.references, self.images, self.marked, self.text = [], [], [], []
        self.style, self.open, self.ids, self.rows = "", [], set(), []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)
        self.references += [given[name] for name in ("src", "href", "srcset") if name in given]
        self.ids |= {given["id"]} if "id" in given else set()
        if tag == "img":
            self.images.append(given)
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
        self.text.append(data)


@pytest.fixture(scope="module")
def report(finished):
    return Page((finished / "report.html").read_text())


def test_the_report_refers_to_nothing_outside_itself(finished, report):
    inside = [reference.removeprefix("#") for reference in report.references if reference[0] == "#"]
    outside = [each for each in report.references if not each.startswith(("#", "data:image/"))]
    assert outside == []
    assert report.ids.issuperset(inside)
    assert inside
    assert not re.search(r"url\(|@import", report.style)
    text = (finished / "report.html").read_text()
    assert not re.search(r"<(script|link|iframe|object|embed|base)\b|\bon\w+=", text)
    assert not re.search(r"https?:", re.sub(r'src="data:[^"]*"', "", text))
    assert not report.open


def test_every_picture_says_what_is_seen(report):
    assert len(report.images) >= 15
    assert all(len(image["alt"]) > 10 for image in report.images)
    assert len({image["src"] for image in report.images}) == len(report.images) - 1  # two of DOT


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


def test_interrupted_at_every_stage_it_goes_on_to_the_same_report(finished, tmp_path, monkeypatch):
    monkeypatch.setattr(demo_parts, "_svg", lambda _: b"<svg/>")  # the numbers are compared
    # A function of that name hides the module.
    monkeypatch.setattr(
        import_module("eitskin.datasets.generation.generate"), "prepare", lambda _: None
    )
    for name in ("quick", "quick_test", "paper_indentation"):
        shutil.copytree(finished / name, tmp_path / name)
    for stage in range(1, len(STAGES)):
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path, at=stage)
        names = sorted(path.stem for path in (tmp_path / RESULTS).iterdir())
        assert names == sorted(each.name for each in STAGES[:stage])
    run(tmp_path)
    assert numbers(tmp_path) == numbers(finished)
    assert not list(tmp_path.rglob(".*"))


def test_what_is_finished_is_not_done_again(finished, tmp_path, monkeypatch):
    folder = shutil.copytree(finished, tmp_path / "demo")
    monkeypatch.setattr("eitskin.cli.demo.folder.train_pipeline", None)
    for module in ("sensor.sensor", "measured.evaluated", "measured.live"):
        monkeypatch.setattr(f"eitskin.cli.demo.{module}", None)
    run(folder)
    first, second = ((at / "report.json").read_text() for at in (finished, folder))
    assert first.replace(str(finished), "") == second.replace(str(folder), "")
    first, second = ((at / "report.html").read_text() for at in (finished, folder))
    assert first.replace(str(finished), "") == second.replace(str(folder), "")


def test_a_stage_is_done_again_when_what_it_is_made_from_changes(tmp_path):
    path = tmp_path / "part.json"
    made = []

    def make():
        made.append(1)
        return Part({"made": len(made), "pair": (1, 2)}, {"dot": Picture("a", "b", "c", DOT, 1.0)})

    first = keep(path, {"seed": 0, "of": ("a", "b")}, make)
    assert first.part.numbers == {"made": 1, "pair": [1, 2]}
    assert keep(path, {"seed": 0, "of": ("a", "b")}, make) == first
    assert keep(path, {"seed": 1, "of": ("a", "b")}, make).part.numbers["made"] == 2
    path.write_bytes(path.read_bytes()[:-20])
    assert keep(path, {"seed": 1, "of": ("a", "b")}, make).part.numbers["made"] == 3


def test_an_interrupt_in_the_midst_of_a_stage_leaves_nothing_of_it(tmp_path, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        keep(tmp_path / "part.json", {}, interrupt)
    monkeypatch.setattr("pathlib.Path.replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        keep(tmp_path / "part.json", {}, lambda: Part({}))
    assert not list(tmp_path.iterdir())


def test_a_pipeline_that_was_removed_or_trained_otherwise_is_trained_again(finished, tmp_path):
    folder = shutil.copytree(finished, tmp_path / "demo")
    there = Demo(tiny_plan(), folder, None, 1, Interrupted())
    assert there._trained()
    otherwise = replace(tiny_plan(), epochs=2)
    assert not Demo(otherwise, folder, None, 1, Interrupted())._trained()
    shutil.rmtree(folder / "demo.eitmodel")
    assert not there._trained()


def test_text_of_files_is_escaped(finished, tmp_path):
    folder = shutil.copytree(finished, tmp_path / "demo")
    data = tmp_path / "<b>&recordings"
    run(folder, data=data)
    page = (folder / "report.html").read_text()
    assert "<b>&" not in page
    assert "&lt;b&gt;&amp;recordings" in page


def test_a_folder_that_cannot_be_used_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigurationError, match="cannot use the folder"):
        Demo(tiny_plan(), tmp_path / "file", None, 1, Output())
    with pytest.raises(PartialError, match="give the same command again"):
        keep(tmp_path / "nowhere" / "part.json", {}, lambda: Part({}))


@pytest.mark.parametrize("what", [KeyboardInterrupt, PartialError])
def test_what_was_stopped_says_how_to_go_on(what, tmp_path, monkeypatch, capsys):
    def stop(*_):
        raise what

    monkeypatch.setattr("eitskin.cli.demo.stages.run_stages", stop)
    with pytest.raises(what):
        demo.command(out=tmp_path / "a b", workers=5, seed=3)
    said = capsys.readouterr().err
    assert f"continue with: eitskin demo --out '{tmp_path}/a b' --workers 5 --seed 3\n" in said


def test_recordings_are_known_by_what_they_hold_and_where_they_are_missed(tmp_path, monkeypatch):
    first, second = (file for file, _ in real_input.RECORDINGS.values())
    assert set(real_input.sums(None).values()) == {"not in None"}
    (tmp_path / first).write_bytes(b"abc")
    found = real_input.sums(tmp_path)
    assert found == {first: hashlib.sha256(b"abc").hexdigest(), second: f"not in {tmp_path}"}

    def refuse(path):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "read_bytes", refuse)
    with pytest.raises(DataError, match=f"cannot read .*{first}: Permission denied; make it"):
        real_input.sums(tmp_path)


def test_missing_packages_are_named_before_anything_is_made(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == "pyvista" else 1)
    with pytest.raises(ImportError, match=r"pyvista; install with pip install 'eitskin\[view\]'"):
        demo.command(out=tmp_path / "demo")
    assert not (tmp_path / "demo").exists()
