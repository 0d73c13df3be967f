"""Hostile inputs by kind: good ones, damaged at random, and what reads them."""

import contextlib
import dataclasses
import hashlib
import io
import json
import random
import re
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
from scipy.io import savemat

from eitskin.config import parse_toml, to_toml
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.recordings.form import RecordingNames
from eitskin.datasets.recordings.recording import read_recording
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.folder import save_dataset
from eitskin.datasets.store.manifest import read_manifest
from eitskin.datasets.store.seal import sealed, unsealed
from eitskin.datasets.store.shard import shard_bytes
from eitskin.datasets.store.shard_reader import shard_of
from eitskin.errors import DataError
from eitskin.geometry.deformation.fixtures import Bend
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.hardware.protocol.frame_parts import FrameData
from eitskin.hardware.protocol.messages import pack, unpack
from eitskin.hardware.protocol.packets import Decoder, MessageError, encode
from eitskin.protocol import Protocol
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.scene.touch import Touch
from eitskin.simulator.simulator import Simulator
from eitskin.training.pipeline.pipeline import Pipeline
from eitskin.training.pipeline.saved_form import SHIPPED, SUMS

Trial = Callable[[random.Random, Path], object]
"""One hostile input: made from random numbers in a folder, and read."""

EXTREMES: Final = (
    *("nan", "inf", "-inf", "-0.0", "0", "-1", "5e-324", "1e-310", "1e-30", "1e-9", "1e9", "1e30"),
    *("1e308", "1e400", "1000000000000", "9" * 400, "9" * 5000, "true", '""', '"\\u0000"', "[]"),
    *("{}", "[" * 2000, '"' + "x" * 200_000 + '"', "[[1], [2, 3]]", "1979-05-27"),
)
NUMBERS: Final = (
    *(float("nan"), float("inf"), -1.0, 0.0, -0.0, 5e-324, 1e-310, 1e-100, 1e-30, 1e-12, 1e-6),
    *(1e6, 1e12, 1e30, 1e100, 1e300, 1.7e308),
)
_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e-?\d+)?(?![\w.])")


def damaged(rng: random.Random, content: bytes) -> bytes:
    """Bytes with bits flipped, parts zeroed, cut, repeated or inserted."""
    place, length = rng.randrange(len(content)), rng.choice((1, 4, 16, 512, 4096))
    flipped = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 4, 32))):
        flipped[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    return rng.choice(
        (
            bytes(flipped),
            bytes(flipped),
            content[:place] + bytes(length) + content[place + length :],
            content[:place] + b"\xff" * length + content[place + length :],
            content[:place],
            content[:place] + rng.randbytes(length) + content[place:],
            content[:place] + content[place + length :],
            content[:place] + content[place // 2 :],
        )
    )


def misworded(rng: random.Random, text: str) -> str:
    """Text of TOML or JSON with numbers replaced by extremes, or lines lost, doubled or swapped."""
    found = list(_NUMBER.finditer(text))
    lines = text.splitlines()
    at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    choice = rng.randrange(6)
    if found and choice < 3:
        for _ in range(rng.choice((1, 1, 3))):
            match = rng.choice(list(_NUMBER.finditer(text)) or found)
            text = text[: match.start()] + rng.choice(EXTREMES) + text[match.end() :]
        return text
    if choice == 3:
        return damaged(rng, text.encode()).decode(errors="replace")
    changed = [[], [lines[at]] * 2, [lines[other]], [rng.choice(EXTREMES)]]
    return "\n".join([*lines[:at], *rng.choice(changed), *lines[at + 1 :]])


def small_dataset(frames: int = 12) -> Dataset:
    """A few frames of nothing in particular, with something in most arrays."""
    rng = np.random.default_rng(0)
    touch = np.full((frames, 4), np.nan)
    touch[::2, 0] = 0.03
    return Dataset.from_arrays(
        500 + rng.normal(size=(frames, 28)) * (1 + 0.1j),
        np.full((1, 28), 500.0),
        touch_x=touch,
        touch_y=touch,
        state=np.arange(frames) % 3,
        bend_angle_deg=np.zeros(frames),
        protocol=Protocol.pairwise(8),
        design=SensorDesign.reference(),
    )


def _toml(kind: type, text: str) -> Trial:
    return lambda rng, folder: parse_toml(kind, misworded(rng, text), folder=folder)


def _manifest(rng: random.Random, folder: Path) -> object:
    path = folder / "set" / "manifest.json"
    if not path.exists():
        save_dataset(small_dataset(), folder / "set", frames_per_shard=4)
        (folder / "good.json").write_bytes(path.read_bytes())
    good = (folder / "good.json").read_bytes()
    mine = rng.random() < 0.5
    path.write_bytes(damaged(rng, good) if mine else misworded(rng, good.decode()).encode())
    return read_manifest(folder / "set")


def _shard(rng: random.Random, folder: Path) -> object:
    content = shard_bytes(small_dataset())
    image, _ = unsealed(content)
    broken = rng.choice((damaged(rng, content), damaged(rng, image), sealed(damaged(rng, image))))
    return shard_of(broken, folder / "shard.h5")


def _model(rng: random.Random, folder: Path) -> object:
    path = folder / "some.eitmodel"
    shutil.rmtree(path, ignore_errors=True)
    shutil.copytree(SHIPPED, path)
    name = rng.choice(("pipeline.json", "pipeline.json", "weights.safetensors", SUMS))
    content = (path / name).read_bytes()
    if name == "pipeline.json" and rng.random() < 0.8:
        broken = misworded(rng, json.dumps(json.loads(content), indent=0)).encode()
    elif name == "weights.safetensors" and rng.random() < 0.5:
        broken = damaged(rng, content[:4000]) + content[4000:]
    else:
        broken = damaged(rng, content)
    (path / name).write_bytes(broken)
    if name != SUMS:
        lines = (path / SUMS).read_text(encoding="utf-8").splitlines()
        sums = [
            f"{hashlib.sha256((path / line[66:]).read_bytes()).hexdigest()}{line[64:]}\n"
            for line in lines
        ]
        (path / SUMS).write_text("".join(sums), encoding="utf-8")
    return Pipeline.load(path)


def _recordings() -> dict[str, bytes]:
    """Content of good recordings by ending."""
    values, x = np.arange(24.0).reshape(8, 3) + 500, np.linspace(0, 0.1, 8)
    made: dict[str, Any] = {ending: io.BytesIO() for ending in ("npz", "mat", "h5")}
    np.savez(made["npz"], v=values, x=x, y=x)
    savemat(made["mat"], {"v": values, "x": x, "y": x}, do_compression=True)
    with h5py.File(made["h5"], "w") as file:
        file["v"], file["x"], file["y"] = values, x, x
    rows = [",".join(map(str, [*row, at, at])) for row, at in zip(values, x, strict=True)]
    contents = {ending: file.getvalue() for ending, file in made.items()}
    contents["csv"] = "\n".join(["v0,v1,v2,x,y", *rows]).encode()
    with contextlib.suppress(ImportError):
        from openpyxl import Workbook

        book, out = Workbook(), io.BytesIO()
        for row in contents["csv"].decode().splitlines():
            book.active.append(row.split(","))
        book.save(out)
        contents["xlsx"] = out.getvalue()
    return contents


def _recording(ending: str, good: bytes) -> Trial:
    def trial(rng: random.Random, folder: Path) -> object:
        text = ending == "csv" and rng.random() < 0.5
        broken = misworded(rng, good.decode()).encode() if text else damaged(rng, good)
        path = folder / f"recording.{ending}"
        path.write_bytes(broken)
        return read_recording(path, RecordingNames("v"))

    return trial


def _port(rng: random.Random, folder: Path) -> object:  # noqa: ARG001
    values = np.array([complex(rng.uniform(400, 800), 1.0) for _ in range(28)], np.complex64)
    frame = FrameData(1, 0.3, 0.297, values, np.zeros(28, np.uint8))
    packet = encode(pack(frame, 1))
    decoder, found = Decoder(), []
    for payload in decoder.feed(damaged(rng, packet) + packet):
        try:
            found.append(unpack(payload))
        except MessageError as error:
            raise DataError(str(error)) from error
    return found


def _extreme(rng: random.Random, folder: Path) -> object:  # noqa: ARG001
    """A frame of a sensor and scene with extreme numbers, which must be finite."""
    design = SensorDesign.reference()
    value: Any = rng.choice(NUMBERS)
    field = rng.choice(("conductivity", "thickness", "impedance", "width", "x", "force", "bend"))
    scene = Scene(Bend(10.0), (Touch(0.05, 0.03, 2.0),))
    if field in ("conductivity", "thickness"):
        design = dataclasses.replace(design, **{field: value})
    elif field in ("impedance", "width"):
        name = {"impedance": "contact_impedance", "width": "width"}[field]
        first, *others = design.electrodes
        changed = dataclasses.replace(first, **{name: value})
        design = dataclasses.replace(design, electrodes=(changed, *others))
    elif field == "bend":
        scene = Scene(Bend(value))
    else:
        known: dict[str, Any] = {"x": 0.05, "y": 0.03, "force": 2.0} | {field: value}
        scene = Scene(touches=(Touch(**known),))
    frame = Simulator(design, resolution="coarse").measure(scene)
    if not np.isfinite(frame.impedance).all():
        raise ArithmeticError("values that are not finite, without an error")
    return frame


def trials() -> Mapping[str, tuple[Trial, float]]:
    """Trials by kind, each with its share of the number of trials."""
    design = to_toml(SensorDesign.reference())
    scene = "bend = { angle_deg = 20.0 }\n[[touches]]\nx = 0.05\ny = 0.03\nforce = 5.0\n"
    recipe = Recipe.shipped("episodes").to_toml()
    found = {
        "TOML: designs": (_toml(SensorDesign, design), 1.0),
        "TOML: scenes": (_toml(Scene, scene), 1.0),
        "TOML: recipes": (_toml(Recipe, recipe), 1.0),
        "manifests": (_manifest, 1.0),
        "shards": (_shard, 1.0),
        "saved pipelines": (_model, 0.2),
        "bytes of a port": (_port, 1.0),
        "extreme numbers": (_extreme, 0.2),
    }
    for ending, good in _recordings().items():
        found[f"recordings: {ending}"] = (_recording(ending, good), 0.5)
    return found
