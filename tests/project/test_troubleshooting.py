"""Every message of docs/how-to/troubleshooting.md occurs, with the exit code of its section."""

import errno
import hashlib
import json
import re
import shutil
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

from eitskin.cli import entry
from eitskin.cli.commands import simulate
from eitskin.cli.main import app
from eitskin.datasets import (
    Dataset,
    Recipe,
    RecordingForm,
    State,
    combine,
    open_dataset,
    read_recording,
    save_dataset,
)
from eitskin.errors import DeviceError, EitskinError, PartialError
from eitskin.extras import require, require_all
from eitskin.files import atomic_folder
from eitskin.geometry import SensorDesign, structured_mesh
from eitskin.geometry.meshing.grading import Grading
from eitskin.hardware import open_board
from eitskin.hardware.boards.port import remedy
from eitskin.simulator import ForwardModel, Frame, Protocol, Scene
from eitskin.training import Pipeline, StoredReference
from eitskin.training.evaluation.evaluate import require_on_sheet
from eitskin.training.method.interface import Calibration
from eitskin.training.pipeline.methods import method_class
from eitskin.training.pipeline.saved_form import SHIPPED_PATH, SUMS, read_pipeline, require_writable

PAGE = Path(__file__).resolve().parents[2] / "docs" / "how-to" / "troubleshooting.md"
SECTIONS = re.split(r"^## .*exit code (\d+)$", PAGE.read_text(), flags=re.MULTILINE)[1:]
ROWS = [
    (int(code), message)
    for code, text in zip(SECTIONS[::2], SECTIONS[1::2], strict=True)
    for message in re.findall(r"^\| `(.+?)` \|", text, re.MULTILINE)
]
SENSOR = "outline = { length = 0.1, width = 0.05 }\n"
SIDE = "electrodes = { count = 6 }\n"
INSIDE = "electrodes = [{ x = 0, y = 0.02 }, { x = 0.03, y = 0.02 }]\n"


def read_as(read, name):
    """Provokes what `read` says of a file `name` with a text."""

    def with_text(text):
        def provoke(folder):
            (folder / name).write_text(text)
            read(folder / name)

        return provoke

    return with_text


scene = read_as(lambda path: simulate.command(path, resolution="fast"), "scene.toml")
design = read_as(SensorDesign.from_toml, "sensor.toml")
recipe = read_as(Recipe.from_toml, "recipe.toml")


def surface(text):
    def provoke(folder):
        (folder / "body.stl").write_text(text)
        design('thickness = 0.004\nelectrodes = []\noutline = { file = "body.stl" }\n')(folder)

    return provoke


def a_triangle():
    corners = "".join(f"vertex {x} {y} 0\n" for x, y in ((0, 0), (0.1, 0), (0, 0.1)))
    return f"solid a\nfacet normal 0 0 1\nouter loop\n{corners}endloop\nendfacet\nendsolid a\n"


def bends_a_surface(folder):
    body = require("trimesh", "mesh").creation.box((0.1, 0.05, 0.004))
    body.export(folder / "body.stl")
    (folder / "sensor.toml").write_text(
        'thickness = 0.004\nencapsulated_thickness = 0.01\noutline = { file = "body.stl" }\n'
        'electrodes = [{ on = "surface", x = -0.05, y = 0, z = 0, width = 0.003 },'
        ' { on = "surface", x = 0.05, y = 0, z = 0, width = 0.003 }]\n'
    )
    (folder / "recipe.toml").write_text(
        'name = "a"\nsensor = "sensor.toml"\nscenes = [{ state = "bend", count = 1 }]\n'
    )
    Recipe.from_toml(folder / "recipe.toml")


def dataset(folder):
    rng = np.random.default_rng(0)
    data = Dataset.from_arrays(
        rng.uniform(500, 800, (6, 28)), rng.uniform(500, 800, 28), state=np.full(6, State.IDLE)
    )
    save_dataset(data, folder / "data")
    return folder / "data"


def changed_shard(change):
    def provoke(folder):
        shard = next(dataset(folder).glob("shard-*.h5"))
        change(shard)
        open_dataset(shard)

    return provoke


def newer(shard):
    with h5py.File(shard, "a") as file:
        file.attrs["format_version"] = 99


def changed_dataset(folder):
    data = dataset(folder)
    with next(data.glob("shard-*.h5")).open("ab") as file:
        file.write(b"more")
    open_dataset(data)


def model(change):
    def provoke(folder):
        copy = folder / "copy.eitmodel"
        shutil.copytree(SHIPPED_PATH, copy)
        change(copy)
        read_pipeline(copy)

    return provoke


def newer_model(folder):
    document = json.loads((folder / "pipeline.json").read_text()) | {"format_version": 9}
    (folder / "pipeline.json").write_text(json.dumps(document))
    sums = [line.split("  ") for line in (folder / SUMS).read_text().splitlines()]
    told = (f"{hashlib.sha256((folder / n).read_bytes()).hexdigest()}  {n}\n" for _, n in sums)
    (folder / SUMS).write_text("".join(told))


def touched_at(x):
    place = np.full((1, 4), x)
    return Dataset.from_arrays(np.ones((1, 3)), np.ones(3), touch_x=place, touch_y=place)


def packed(folder):
    (folder / "copy.eitmodel").write_bytes(b"PK")
    read_pipeline(folder / "copy.eitmodel")


def another_sensor(_):
    frame = Frame(np.linspace(400, 800, 15) + 0j, Protocol.pairwise(6))
    Pipeline.load("reference.eitmodel").process(frame)


def calibrates_without_bending(_):
    Calibration((20.0,), (1.0,), (1.0,), residual_deg=20.0).require_fit(np.array([20.0]))


def bent_reference(_):
    pipeline = Pipeline.load("reference.eitmodel")
    known = pipeline.flat_sensors
    bent = np.exp(known.mean + 50.0 / 45.0 * known.bend[0] + (50.0 / 45.0) ** 2 * known.bend[1])
    scale = np.median(pipeline.layout.reference / bent)
    pipeline.tare([Frame(scale * bent, pipeline.layout.protocol)])


def moving_reference(_):
    pipeline = Pipeline.load("reference.eitmodel")
    still, protocol = pipeline.layout.reference, pipeline.layout.protocol
    pipeline.tare([Frame(still, protocol), Frame(1.1 * still, protocol, number=1)])


def damaged_reference(folder):
    (folder / "r.json").write_text("{")
    StoredReference.read(folder / "r.json")


def recording(text, **more):
    def provoke(folder):
        (folder / "a.csv").write_text(text)
        read_recording(folder / "a.csv", **more)

    return provoke


def combined(folder):
    save_dataset(Dataset.from_arrays(np.ones((2, 15))), folder / "other")
    combine([dataset(folder), folder / "other"], folder / "both")


def no_permission(_):
    # Whoever runs the tests may have every right, so the system's own words are given.
    said = remedy(PermissionError(errno.EACCES, "Permission denied"))
    raise DeviceError(f"serial:X: cannot open the port: {said}")


def no_room(folder):
    with atomic_folder(folder / "a", PartialError, "make room, or choose another place"):
        raise OSError(errno.ENOSPC, "No space left on device")


def plain_file(folder):
    (folder / "port").write_text("")
    open_board(f"serial:{folder / 'port'}")


PROVOKED = {
    "... is needed here": lambda _: require("no_such_package", "mesh"),
    "needed here and": lambda _: require_all(mesh="no_such_package", view="nor_this"),
    "cannot read ": lambda folder: Scene.from_toml(folder / "none.toml"),
    "... is not valid TOML": scene("[bend\n"),
    "...: unknown key": scene("[bend]\nangle_rad = 0.5\n"),
    "...: expected a finite": scene("[bend]\nangle_deg = nan\n"),
    "... must be between 1 um": design(
        "thickness = 4.0\noutline = { length = 100, width = 50 }\n" + SIDE
    ),
    "a touch must lie": scene("touches = [{ x = 50, y = 20 }]\n"),
    "indenter radius": scene("touches = [{ x = 0.05, y = 0.02, indenter = { radius = 7.5 } }]\n"),
    "...: touch force": scene("touches = [{ x = 0.05, y = 0.02, force = -1 }]\n"),
    "force must be above": scene("touches = [{ x = 0.05, y = 0.02, force = 1000 }]\n"),
    "this sensor is solved": scene("[bend]\nangle_deg = 999\n"),
    "thickness must be": design("thickness = -0.004\n" + SENSOR + SIDE),
    "electrode ...: ": design("thickness = 0.004\n" + SENSOR + INSIDE),
    "bending and touches": bends_a_surface,
    "sensor: a design file": recipe('name = "a"\nsensor = { file = "six.toml" }\n'),
    "there is no shipped": lambda _: Recipe.from_shipped("quikc"),
    "the surface in": surface(a_triangle()),
    "... holds no triangles": surface(""),
    "a grid of": lambda _: structured_mesh(SensorDesign.reference(), Grading(1e-5, 1e-5, 1.0)),
    "a forward model of": lambda _: ForwardModel(
        SensorDesign.reference(), ((10,) * 6, Grading(5e-3, 1e-2, 1.0))
    ),
    "expected a path NAME.eitmodel": lambda folder: Pipeline.load(SHIPPED_PATH).save(
        folder / "a.zip"
    ),
    "... exists and is not replaced": lambda _: require_writable(SHIPPED_PATH, replace=False),
    "this pipeline was trained by": lambda _: method_class("my:Net"),
    "expected a board": lambda _: open_board("tcp:1.2.3.4"),
    "... is not a complete": open_dataset,
    "... is not a whole": changed_shard(lambda path: path.write_bytes(path.read_bytes()[:3000])),
    "...: format version": changed_shard(newer),
    "... is not the file that the": changed_dataset,
    "there is no pipeline": lambda folder: read_pipeline(folder / "none.eitmodel"),
    "... is a file": packed,
    "... is not the file that was": model(lambda path: (path / "README.md").write_text("")),
    "... has format version": model(newer_model),
    "this pipeline was trained": another_sensor,
    "cannot find the": recording("w0,w1\n1,2\n"),
    "positions must be": recording("v0,v1,x,y\n1,2,15,30\n"),
    "positions must lie": recording("v0,x,y\n1,-0.01,0.01\n", design=SensorDesign.reference()),
    "the protocol has": recording("v0,v1\n1,2\n", protocol=Protocol.pairwise(8)),
    "impedance must be": recording("v0,v1\n1,\n"),
    "expected rows": recording("v0\n1\n", form=RecordingForm("before-during")),
    "... cannot be combined": combined,
    "... must be at most": lambda _: touched_at(135.0),
    "touches of the": lambda _: require_on_sheet(touched_at(1.35), (0.15, 0.06)),
    "the sensor does not look flat": bent_reference,
    "expected frames of a still": moving_reference,
    "... is no whole reference": damaged_reference,
    "the frames do not fit": calibrates_without_bending,
    "...: cannot open the port: there is none": lambda _: open_board("serial:/dev/none-such"),
    "...: cannot open the port: ...; check": plain_file,
    "...: cannot open the port: another": lambda _: open_board("virtual:?faults=port_in_use"),
    "...: cannot open the port: no permission": no_permission,
    "cannot write": no_room,
}


@pytest.mark.parametrize(("code", "message"), ROWS)
def test_the_message_occurs(code, message, tmp_path):
    beginnings = [each for each in PROVOKED if message.startswith(each)]
    provoke = PROVOKED[max(beginnings, key=len)]
    with pytest.raises((EitskinError, ImportError)) as caught:
        provoke(tmp_path)
    pattern = ".*".join(map(re.escape, message.split("...")))
    assert re.search(pattern, str(caught.value), re.DOTALL), str(caught.value)
    assert getattr(caught.value, "exit_code", 2) == code


def test_each_is_listed_once():
    assert len(ROWS) == len(set(ROWS)) == len(PROVOKED)


def test_a_command_that_is_interrupted_says_so(tmp_path, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("eitskin.simulator.scene.scene.Scene.from_toml", interrupt)
    ran = CliRunner().invoke(app, ["simulate", str(tmp_path / "scene.toml")])
    assert ran.exit_code == 130
    assert ran.stderr == "eitskin: interrupted\n"


class Interrupts:
    """Has Ctrl-C come when `eitskin.cli.main` is about to be loaded."""

    def find_spec(self, name, *_):
        if name == "eitskin.cli.main":
            raise KeyboardInterrupt


def test_ctrl_c_while_the_commands_load_says_so(monkeypatch, capsys):
    monkeypatch.delattr("eitskin.cli.main")
    monkeypatch.delitem(sys.modules, "eitskin.cli.main")
    monkeypatch.setattr(sys, "meta_path", [Interrupts(), *sys.meta_path])
    with pytest.raises(SystemExit) as ended:
        entry.run()
    assert ended.value.code == 130
    assert capsys.readouterr().err == "eitskin: interrupted\n"


@pytest.mark.parametrize(
    ("arguments", "extras"),
    [
        ("bench paper", "training,bench"),
        ("bench layouts", "bench"),
        ("bench speed", "training,bench"),
        ("bench accuracy", "bench"),
        ("bench all", "training,bench"),
        ("train data --out a.eitmodel", "training"),
        ("demo", "training,view"),
    ],
)
def test_all_that_is_missing_is_named_before_the_work(arguments, extras, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for name in ("torch", "safetensors", "matplotlib"):
        monkeypatch.setitem(sys.modules, name, None)
    ran = CliRunner().invoke(app, arguments.split())
    assert isinstance(ran.exception, ImportError)
    assert str(ran.exception).endswith(f"pip install 'eitskin[{extras}]'")
    assert not list(tmp_path.iterdir())
