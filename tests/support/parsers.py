"""Parsers of files from strangers: what each reads, and files that are as they should be."""

import hashlib
import shutil
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from eitskin.config import read_toml, to_toml
from eitskin.datasets.recipe import shipped_names
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.recordings.source import read_source
from eitskin.datasets.store.folder import save_dataset
from eitskin.datasets.store.manifest import read_manifest
from eitskin.geometry.deformation.fixtures import Clamp, Fixture, FreeArc, Hinge
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.hardware.boards.text_lines import FrameFinder, LineDecoder
from eitskin.hardware.protocol.frame_parts import FrameAssembly, FrameData, FramePart, frame_packets
from eitskin.hardware.protocol.messages import unpack
from eitskin.hardware.protocol.packets import Decoder, MessageError, encode
from eitskin.hardware.virtual.stage import Script
from eitskin.protocol import Protocol
from eitskin.reader_process import Answer
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.scene.scene import Scene
from eitskin.training.method.predictions import Zero
from eitskin.training.pipeline.pipeline import open_pipeline
from eitskin.training.pipeline.references import StoredReference
from eitskin.training.pipeline.saved_form import DOCUMENT, SHIPPED_PATH, SUMS
from eitskin.training.twin.parameters import TwinPrior

import small_dataset


@dataclass(frozen=True, slots=True)
class Parser:
    """Reader of one kind of file.

    Attributes:
        name: of the file.
        good: contents that are as they should be.
        read: what reads the file of a path.
    """

    name: str
    good: Callable[[], tuple[bytes, ...]]
    read: Callable[[Path], object]

    def parse(self, content: bytes, folder: Path) -> object:
        """Object read from a file of this content; an EitskinError where that is refused."""
        path = folder / self.name
        path.write_bytes(content)
        return self.read(path)


SCENE = """[bend]
angle_deg = 20.0
[[touches]]
x = 0.05
y = 0.03
force = 5.0
[[touches]]
x = 0.02
y = 0.02
depth = 0.001
indenter = { radius = 0.005 }
"""
SCRIPT = "repeat = true\n[[steps]]\nframes = 10\n[steps.scene]\nbend = { angle_deg = 5.0 }\n"
LINE = b"Freq:40000.00 RzMag: 612.500000 Ohm , RzPhase: -1.250000\r\n"


@lru_cache
def _designs() -> tuple[bytes, ...]:
    recipes = [Recipe.from_shipped(name).sensor for name in shipped_names()]
    return tuple(dict.fromkeys(_written(SensorDesign.reference(), *recipes)))


@lru_cache
def _recipes() -> tuple[bytes, ...]:
    return tuple(Recipe.from_shipped(name).to_toml().encode() for name in shipped_names())


def _written(*configurations: Any) -> tuple[bytes, ...]:
    return tuple(to_toml(each).encode() for each in configurations)


def _saved(name: str, save: Callable[[Path], object]) -> tuple[bytes, ...]:
    """Content of a file that is saved."""
    with tempfile.TemporaryDirectory() as folder:
        save(Path(folder) / name)
        return ((Path(folder) / name).read_bytes(),)


@lru_cache
def _protocols() -> tuple[bytes, ...]:
    return _saved("protocol.csv", Protocol.adjacent(8).to_file)


@lru_cache
def _manifests() -> tuple[bytes, ...]:
    def save(path: Path) -> None:
        save_dataset(small_dataset.make(12), path.parent / "set", frames_per_shard=4)
        shutil.copyfile(path.parent / "set" / path.name, path)

    return _saved("manifest.json", save)


@lru_cache
def _references() -> tuple[bytes, ...]:
    pairs = Protocol.pairwise(8)
    made = StoredReference(np.full(28, 500 + 1j), pairs, 40e3, Zero.FLAT, 5, 1e-4, "2026-11-24")
    return _saved("reference.json", made.write)


@lru_cache
def _tables() -> Mapping[str, tuple[bytes, ...]]:
    """Recordings as text, by ending."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0.01, 0.09, 12), rng.uniform(0.01, 0.05, 12)
    values = 500 + 1000 * np.stack([x, y, x * y, np.ones(12)], 1)
    rows = np.column_stack([values, x, y, np.full(12, 2.0), np.ones(12)]).tolist()
    lines = [["v0", "v1", "v2", "v3", "x", "y", "force", "state"], *(map(str, r) for r in rows)]
    openeit = (" , ".join(f"{cell:.3f}" for cell in row) for row in values)
    return {
        "csv": ("\n".join(map(",".join, lines)).encode(),),
        "txt": ("\n".join(f"magnitudes : {line}" for line in openeit).encode(),),
    }


def _table(path: Path) -> list[Answer]:
    """Answers of a child that reads a recording, read here."""
    ask: dict[str, Any] = {"path": str(path), "options": {}}
    (head,) = read_source(ask | {"wanted": None}, b"")
    values, *labels = names = head.data["header"] or head.data["names"]
    columns = {name: [column] for column, name in enumerate(names)}
    wanted = {"values": (values,), "labels": tuple(labels), "columns": columns}
    return [head, *read_source(ask | {"wanted": wanted}, b"")]


def _pipeline(path: Path) -> object:
    """The shipped pipeline with another document, whose sums are right."""
    folder = path.parent / "changed.eitmodel"
    if not folder.exists():
        shutil.copytree(SHIPPED_PATH, folder)
    content = path.read_bytes()
    (folder / DOCUMENT).write_bytes(content)
    digest = hashlib.sha256(content).hexdigest()
    lines = (SHIPPED_PATH / SUMS).read_text(encoding="utf-8").splitlines()
    sums = [digest + each[64:] if each.endswith(DOCUMENT) else each for each in lines]
    (folder / SUMS).write_text("\n".join(sums) + "\n", encoding="utf-8")
    return open_pipeline(folder)


def _packets() -> tuple[bytes, ...]:
    """Bytes of a board: a frame of one packet, and one of several."""
    made = (FrameData(1, 0.3, 0.297, np.full(n, 500 + 1j), np.zeros(n, "u1")) for n in (28, 300))
    return tuple(b"".join(map(encode, frame_packets(each, 0))) for each in made)


def _of_port(path: Path) -> list[object]:
    """Messages and frames in the bytes of a port; those that are none are dropped."""
    decoder = Decoder()
    found: list[object] = []
    assembly = FrameAssembly(decoder.drops)
    for packet in decoder.feed(path.read_bytes()):
        with suppress(MessageError):
            message = unpack(packet)
            found.append(assembly.add(message) if isinstance(message, FramePart) else message)
    return found


def _of_lines(path: Path) -> list[object]:
    """Frames in the lines of a text board, which come in pieces; an empty line is a pause."""
    decoder, finder, clock = LineDecoder(), FrameFinder(4, marked=False, pause=0.5), 0.0
    found: list[object] = []
    for group in path.read_bytes().split(b"\r\n\r\n"):
        clock += 1.0
        for at in range(0, len(group) + 2, 50):
            clock += 0.01
            found += finder.feed(clock, decoder.feed((group + b"\r\n")[at : at + 50]))
    return found


def _toml(kind: Any, *good: Any) -> Parser:
    """Parser of the TOML form of a kind."""
    return Parser("input.toml", lambda: _written(*good), partial(read_toml, kind))


PARSERS: Final[Mapping[str, Parser]] = {
    "TOML: designs": Parser("input.toml", _designs, SensorDesign.from_toml),
    "TOML: scenes": Parser("input.toml", lambda: (SCENE.encode(),), Scene.from_toml),
    "TOML: recipes": Parser("input.toml", _recipes, Recipe.from_toml),
    "TOML: fixtures": _toml(Fixture, Clamp(), FreeArc(0.1), Hinge()),
    "TOML: mechanics": _toml(Mechanics, Mechanics()),
    "TOML: instruments": _toml(Instrument, Instrument.ad5940()),
    "TOML: priors of twins": _toml(TwinPrior, TwinPrior()),
    "TOML: scripts of scenes": Parser("input.toml", lambda: (SCRIPT.encode(),), Script.from_toml),
    "protocols (CSV)": Parser("input.csv", _protocols, lambda path: Protocol.from_file(path, 8)),
    "manifests (JSON)": Parser(
        "manifest.json", _manifests, lambda path: read_manifest(path.parent)
    ),
    "stored references (JSON)": Parser("input.json", _references, StoredReference.read),
    "saved pipelines: pipeline.json": Parser(
        "input.json", lambda: ((SHIPPED_PATH / DOCUMENT).read_bytes(),), _pipeline
    ),
    "recordings: csv": Parser("input.csv", lambda: _tables()["csv"], _table),
    "recordings: txt": Parser("input.txt", lambda: _tables()["txt"], _table),
    "bytes of a port": Parser("input.bin", _packets, _of_port),
    "lines of text boards": Parser("input.bin", lambda: ((LINE * 4 + b"\r\n") * 4,), _of_lines),
}
"""Parsers written in Python, by kind; their guided trials see which lines an input reaches."""
