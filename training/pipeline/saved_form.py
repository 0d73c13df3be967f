"""`NAME.eitmodel/`: a trained pipeline on disk, checked on loading, without pickle.

pipeline.json          format, version, what it was trained for, how, and how well
weights.safetensors    every array
golden.safetensors     inputs, and the outputs that the loaded pipeline must give for them
README.md              model card
SHA256SUMS             of the four, as sha256sum -c reads it
"""

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError, DataError, PartialError
from eitskin.extras import require
from eitskin.files import atomic_folder

FORMAT = "eitskin-pipeline"
FORMAT_VERSION = 1
SUFFIX = ".eitmodel"
SHIPPED = Path(__file__).parents[1] / f"reference{SUFFIX}"
GOLDEN_TOLERANCE = (
    1e-3  # of outputs, relative to the largest; float32 convolutions sum in any order
)

DOCUMENT, WEIGHTS, GOLDEN, CARD, SUMS = (
    "pipeline.json",
    "weights.safetensors",
    "golden.safetensors",
    "README.md",
    "SHA256SUMS",
)

MADE_WITH = ("numpy", "scikit-learn", "scipy", "torch")

Arrays = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class SavedPipeline:
    """What such a folder holds.

    Attributes:
        kind: which stages these are, "perception" or "touch position".
        document: layout, hyper-parameters and metrics, as JSON takes them.
        weights: arrays of the stages.
        golden: arrays `input.*` and `output.*`.
        card: text of the model card.
    """

    kind: str
    document: Mapping[str, Any]
    weights: Arrays
    golden: Arrays
    card: str

    def require_golden(self, outputs: Arrays) -> None:
        """Refuse `outputs` that differ from the golden ones of the same names."""
        for name, value in outputs.items():
            expected = self.golden.get(f"output.{name}")
            if expected is None or expected.shape != np.shape(value):
                raise DataError(f"the golden outputs hold no fitting '{name}'; save it again")
            error = float(np.max(np.abs(value - expected), initial=0.0))
            allowed = GOLDEN_TOLERANCE * float(np.max(np.abs(expected), initial=0.0))
            if not error <= allowed:
                raise DataError(
                    f"this pipeline does not compute here what it computed when it was saved: "
                    f"'{name}' differs by {error:.3g}, allowed is {allowed:.3g}; install the "
                    "package versions that pipeline.json names, or train it again"
                )


def write_pipeline(path: str | Path, saved: SavedPipeline) -> Path:
    """Write `saved` as the folder `path`, whole or not at all; a pipeline there is replaced.

    Raises ConfigurationError where `path` does not end in .eitmodel or is something else, and
    PartialError where it cannot be written.
    """
    path = Path(path)
    require_place(path)
    files = _files(saved)
    sums = "".join(f"{_sha256(data)}  {name}\n" for name, data in files.items())
    files[SUMS] = sums.encode()
    with atomic_folder(path, PartialError, "make room, or choose another place") as folder:
        for name, data in files.items():
            (folder / name).write_bytes(data)
    return path


def read_pipeline(path: str | Path) -> SavedPipeline:
    """Read the folder `path`.

    "reference.eitmodel", where no such folder is, is the pipeline that comes with eitskin.

    Raises DataError where it is no pipeline, is damaged, changed, or newer than this eitskin.
    """
    safetensors = require("safetensors.numpy", "training")
    damaged = require("safetensors", "training").SafetensorError
    path = Path(path)
    if str(path) == SHIPPED.name and not path.exists():
        path = SHIPPED
    files = _checked_files(path)
    try:
        document = json.loads(files[DOCUMENT])
        if document["format"] != FORMAT:
            raise DataError(f"{path}: expected format '{FORMAT}', got '{document['format']}'")
        if document["format_version"] > FORMAT_VERSION:
            raise DataError(
                f"{path} has format version {document['format_version']}, this eitskin reads up to "
                f"{FORMAT_VERSION}; install a newer eitskin"
            )
        return SavedPipeline(
            document["kind"],
            document,
            safetensors.load(files[WEIGHTS]),
            safetensors.load(files[GOLDEN]),
            files[CARD].decode(),
        )
    except DataError:
        raise
    except (ValueError, KeyError, TypeError, damaged) as error:
        raise DataError(f"{path} is no pipeline that can be read: {error!r}") from error


def require_kind(saved: SavedPipeline, kind: str, path: str | Path) -> None:
    """Refuse a pipeline of another kind than the one that is wanted."""
    if saved.kind != kind:
        raise DataError(f"{path} holds a '{saved.kind}' pipeline, a '{kind}' one is needed here")


def require_place(path: Path) -> None:
    """Refuse a place where no pipeline can be saved, before the work of making one."""
    if path.suffix != SUFFIX:
        raise ConfigurationError(f"a pipeline is saved as NAME{SUFFIX}, got {path}")
    if path.exists() and not (path / SUMS).is_file():
        raise ConfigurationError(f"{path} exists and is no pipeline; choose another name")
    folder = next(each for each in path.absolute().parents if each.exists())
    if not (folder.is_dir() and os.access(folder, os.W_OK)):
        raise ConfigurationError(f"{path} cannot be made: {folder} may not be written to")


def _files(saved: SavedPipeline) -> dict[str, bytes]:
    safetensors = require("safetensors.numpy", "training")
    document = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "kind": saved.kind,
        "made_with": {name: version(name) for name in MADE_WITH},
        **saved.document,
    }

    def plain(arrays: Arrays) -> dict[str, NDArray[Any]]:
        return {name: np.array(array, order="C") for name, array in arrays.items()}

    return {
        DOCUMENT: json.dumps(document, indent=1, allow_nan=False).encode(),
        WEIGHTS: safetensors.save(plain(saved.weights)),
        GOLDEN: safetensors.save(plain(saved.golden)),
        CARD: saved.card.encode(),
    }


def _checked_files(path: Path) -> dict[str, bytes]:
    """The files that the sums name, every one of them and unchanged."""
    if path.is_file():
        raise DataError(f"{path} is a file, a pipeline is a folder; unpack it if it was packed")
    if not path.is_dir():
        raise DataError(f"there is no pipeline {path}; make one with eitskin train")
    try:
        lines = (path / SUMS).read_text(encoding="utf-8").splitlines()
        sums = {line[66:]: line[:64] for line in lines}
        files = {name: (path / name).read_bytes() for name in (DOCUMENT, WEIGHTS, GOLDEN, CARD)}
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path} is not a whole pipeline: {error}; copy it again") from error
    for name, data in files.items():
        if _sha256(data) != sums.get(name):
            raise DataError(
                f"{path / name} is not the file that was saved: its SHA-256 is not the one in "
                f"{SUMS}; copy it again"
            )
    return files


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
