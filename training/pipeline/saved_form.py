"""Saved form of a trained pipeline, the folder `NAME.eitmodel`, checked on loading, without pickle.

pipeline.json          format, version, layout, settings, training set and metrics
weights.safetensors    every array
golden.safetensors     inputs, and the outputs for them before saving
README.md              model card
SHA256SUMS             of the four, as sha256sum -c reads it
"""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from eitskin.config import from_dict
from eitskin.errors import ConfigurationError, DataError, PartialError
from eitskin.extras import require
from eitskin.files import atomic_folder, parse_json, quote_value, read_bytes, read_text
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.training.adaptation.touch_positions import with_common_form
from eitskin.training.method.settings import POSITIONS

FORMAT = "eitskin-pipeline"
FORMAT_VERSION = 1
KIND = "perception"
SUFFIX = ".eitmodel"
SHIPPED_PATH = Path(__file__).parents[1] / f"reference{SUFFIX}"
MAX_BYTES = 1 << 32  # of one file
GOLDEN_TOLERANCE = 1e-3  # relative to the largest output; float32 sums depend on their order
FIT_TOLERANCE = 0.05
"""The same of the outputs of a fit, as norms over a frame. A fit ends where a further step gains
next to nothing, and that is within some hundredths of a standard error, not to so many digits."""
FIT_SHARE = 0.5
"""Least share of the frames with an output in which a fit must find the same. One in twenty frames
has several explanations that fit about as well: steps that are chosen otherwise, as by another
version, may end at another one. Wrong weights change all frames."""

DOCUMENT, WEIGHTS, GOLDEN, CARD, SUMS = (
    "pipeline.json",
    "weights.safetensors",
    "golden.safetensors",
    "README.md",
    "SHA256SUMS",
)

RECORDED_PACKAGES = ("numpy", "scikit-learn", "scipy", "torch")

Arrays = Mapping[str, NDArray[Any]]

DAMAGE: Final = (
    ArithmeticError,
    AttributeError,
    LookupError,
    RecursionError,
    RuntimeError,
    TypeError,
    ValueError,
)
"""Errors by which arrays of wrong shapes and documents of wrong types are noticed."""

_MAX_SIZE: Final = 1e30  # beyond which products in single precision overflow
_MAX_ANGLE_DEG: Final = 360.0  # the fit looks at every few degrees of the range
_MAX_EXAMPLES: Final = 4096  # golden frames, which are computed when a pipeline is opened
_MAX_NOISE: Final = 1.0

CARD_TEXT: Final = """\
# A perception pipeline for electrical-impedance robot skin

Load it with `eitskin.training.Pipeline.load`; it needs eitskin and {code}, and holds no
pickled objects.

**Made for** {sensor} a frame{frequency}, values in ohm. Frames of another table
or frequency are refused.

**Estimates** {estimates}.

**Trained on** {frames} {source} frames by the {method} method. Conditions absent from
these frames (other indenters, wear) are untested.

**Limits.** A session must begin with the sensor flat and untouched.{limits}

## Metrics

```json
{metrics}
```
"""
ANGLE_LIMITS: Final = """ The gain of an uncalibrated
angle has an error of 10 % and more between sensors of one design: calibrate. For a touched
sensor the paper's method gives the angle before the touch."""
FLAT_LIMITS: Final = """ It was trained without bends:
a sensor that is bent later may be taken for a touched one."""
POSITION_LIMITS: Final = """ Whether it is touched later is not
estimated: a change of at least a fifth of the usual touch is given a position."""


@dataclass(frozen=True, slots=True)
class SavedPipeline:
    """Contents of the folder.

    Attributes:
        document: layout, settings and metrics, as JSON takes them.
        weights: trained arrays by name.
        golden: arrays `input.*` and `output.*`, by which the loaded pipeline is checked.
    """

    document: Mapping[str, Any]
    weights: Arrays
    golden: Arrays

    @property
    def adaptation(self) -> dict[str, Any]:
        """Result of the adaptation to one sensor; version 0.1 shows of its calibration alone."""
        calibration = self.document.get("calibration")
        calibration_facts = {"calibration": calibration} if calibration else {}
        return dict(self.document.get("adaptation", calibration_facts))

    def require_golden(self, outputs: Arrays, fitted: bool = False) -> None:
        """Check `outputs` against the golden ones of the same names; raises DataError.

        Args:
            outputs: arrays (n, ...) by name, of n frames.
            fitted: whether they are where an iterative fit ended: see `FIT_TOLERANCE`.
        """
        for name, value in outputs.items():
            expected = self.golden.get(f"output.{name}")
            if expected is None or expected.shape != np.shape(value):
                raise DataError(
                    f"expected a golden output '{name}' of shape {np.shape(value)}, got "
                    f"{expected if expected is None else expected.shape}; save the pipeline again"
                )
            finite = np.isfinite(expected)
            same = np.array_equal(np.isfinite(value), finite)
            error, allowed = (_fit_error if fitted else _error)(
                np.where(finite, expected, 0.0), np.where(finite, value, 0.0)
            )
            if not (same and error <= allowed):
                raise DataError(
                    f"this pipeline does not compute here what it computed when it was saved: "
                    f"'{name}' differs by {error:.3g}, allowed is {allowed:.3g}; install the "
                    "package versions that pipeline.json names, or train it again"
                )


def _error(expected: NDArray[Any], found: NDArray[Any]) -> tuple[float, float]:
    """Largest difference of two arrays, and the largest that is allowed."""
    largest = float(np.max(np.abs(expected), initial=0.0))
    return float(np.max(np.abs(found - expected), initial=0.0)), GOLDEN_TOLERANCE * largest


def _fit_error(expected: NDArray[Any], found: NDArray[Any]) -> tuple[float, float]:
    """Difference of the outputs (n, ...) of a fit that `FIT_SHARE` of the frames keep within.

    Frames whose outputs are zero must keep them.
    """
    rows = (len(expected), -1)
    size = np.linalg.norm(expected.reshape(rows), axis=1)
    errors = np.linalg.norm((found - expected).reshape(rows), axis=1)
    allowed = FIT_TOLERANCE * float(size.max(initial=0.0))
    told = size > allowed
    middle = float(np.quantile(errors[told], FIT_SHARE, method="lower")) if told.any() else 0.0
    return max(middle, float(errors[~told].max(initial=0.0))), allowed


def write_pipeline(path: str | Path, saved: SavedPipeline) -> Path:
    """Write the folder `path`, whole or not at all, replacing a pipeline there.

    Raises ConfigurationError for a path that does not end in .eitmodel or is no pipeline, and
    PartialError where the folder cannot be written.
    """
    path = Path(path)
    require_writable(path)
    safetensors = require("safetensors.numpy", "live")
    document = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "kind": KIND,
        "made_with": {name: version(name) for name in RECORDED_PACKAGES},
        **saved.document,
    }
    weights, golden = (
        safetensors.save({name: np.array(array, order="C") for name, array in arrays.items()})
        for arrays in (saved.weights, saved.golden)
    )
    files = {
        DOCUMENT: json.dumps(document, indent=1, allow_nan=False).encode(),
        WEIGHTS: weights,
        GOLDEN: golden,
        CARD: model_card(saved.document).encode(),
    }
    sums = "".join(f"{sha256(data).hexdigest()}  {name}\n" for name, data in files.items())
    files[SUMS] = sums.encode()
    with atomic_folder(path, PartialError, "make room, or choose another folder") as folder:
        for name, data in files.items():
            (folder / name).write_bytes(data)
    return path


def read_pipeline(path: str | Path) -> SavedPipeline:
    """Contents of the folder `path`.

    "reference.eitmodel", unless a folder of that name exists, is the pipeline that comes with
    eitskin.

    Raises DataError for a path that is no pipeline, or one that is damaged, changed, or newer than
    this eitskin.
    """
    safetensors = require("safetensors.numpy", "live")
    damaged = require("safetensors", "live").SafetensorError
    path = Path(path)
    if str(path) == SHIPPED_PATH.name and not path.exists():
        path = SHIPPED_PATH
    files = _checked_files(path)
    try:
        document = parse_json(files[DOCUMENT])
        if document["format"] != FORMAT:
            raise DataError(
                f"{path}: expected format '{FORMAT}', got {quote_value(document['format'])}"
            )
        if document["format_version"] > FORMAT_VERSION:
            raise DataError(
                f"{path} has format version {document['format_version']}, this eitskin reads up to "
                f"{FORMAT_VERSION}; install a newer eitskin"
            )
        kind = document["kind"]
        arrays = safetensors.load(files[WEIGHTS]), safetensors.load(files[GOLDEN])
        if kind == POSITIONS:
            return SavedPipeline(*with_common_form(document, *arrays))
        if kind != KIND:
            raise DataError(
                f"expected a '{KIND}' pipeline, got a {quote_value(kind)} one: {path}; name another"
            )
        return SavedPipeline(document, *arrays)
    except DataError:
        raise
    except (*DAMAGE, damaged) as error:
        raise DataError(f"{path} is no pipeline that can be read: {error!r}") from error


def require_writable(path: Path, replace: bool = True) -> None:
    """Check that a pipeline can be saved as `path`, before training; raises ConfigurationError.

    Args:
        path: path of the pipeline.
        replace: whether it may take the place of another pipeline.
    """
    if path.suffix != SUFFIX:
        raise ConfigurationError(f"expected a path NAME{SUFFIX} for the pipeline, got {path}")
    if path.exists() and not (path / SUMS).is_file():
        raise ConfigurationError(f"{path} exists and is no pipeline; choose another name")
    if path.exists() and not replace:
        raise ConfigurationError(
            f"{path} exists and is not replaced; choose another name, or give --replace"
        )
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    if not (folder.is_dir() and os.access(folder, os.W_OK)):
        raise ConfigurationError(f"{path} cannot be made: {folder} may not be written to")


def _checked_files(path: Path) -> dict[str, bytes]:
    """Contents of all files, whose SHA-256 must be those of the sums; raises DataError."""
    if path.is_file():
        raise DataError(f"{path} is a file, a pipeline is a folder; unpack it if it was packed")
    if not path.is_dir():
        near = path.with_name(f"{path.name}{SUFFIX}")
        meant = near.is_dir() or near.name == SHIPPED_PATH.name
        hint = f"did you mean {near}?" if meant else "make one with eitskin train"
        raise DataError(f"there is no pipeline {path}; {hint}")
    try:
        lines = read_text(path / SUMS, failure=DataError).splitlines()
        sums = {line[66:]: line[:64] for line in lines}
        files = {
            name: read_bytes(path / name, MAX_BYTES, DataError)
            for name in (DOCUMENT, WEIGHTS, GOLDEN, CARD)
        }
    except DataError as error:
        raise DataError(f"{path} is not a whole pipeline: {error}; copy it again") from error
    for name, data in files.items():
        if sha256(data).hexdigest() != sums.get(name):
            raise DataError(
                f"{path / name} is not the file that was saved: its SHA-256 is not the one in "
                f"{SUMS}; copy it again"
            )
    return files


def require_possible(weights: Arrays, golden: Arrays, noise: Any) -> float:
    """Noise of a pipeline; raises DataError for numbers that no training gives.

    Args:
        weights: arrays of the pipeline by name: no NaN and nothing immense, angles within a turn;
            minus infinity is the logarithm of an impossible place.
        golden: arrays by which the pipeline is checked: few frames.
        noise: rms of the relative difference of two frames.
    """
    for name, array in weights.items():
        if array.dtype.kind not in "biufc":
            raise DataError(f"expected numbers in '{name}', got {array.dtype}; train it again")
        size = np.abs(np.where(array == -np.inf, 0, array))
        if not np.all(size <= _MAX_SIZE):
            raise DataError(
                f"expected finite numbers up to {_MAX_SIZE:g} in '{name}', got others; train it "
                "again"
            )
        if name.endswith("angle_deg") and np.any(np.abs(array) > _MAX_ANGLE_DEG):
            raise DataError(
                f"expected angles up to {_MAX_ANGLE_DEG:g} deg in '{name}', got "
                f"{float(np.abs(array).max()):g}; train it again"
            )
    for name, array in golden.items():
        if array.ndim and len(array) > _MAX_EXAMPLES:
            raise DataError(
                f"expected at most {_MAX_EXAMPLES} golden frames in '{name}', got {len(array)}; "
                "save the pipeline again"
            )
    if type(noise) not in (int, float) or not 0 <= noise <= _MAX_NOISE:
        raise DataError(f"expected a noise from 0 to {_MAX_NOISE:g}, got {quote_value(noise)}")
    return float(noise)


def model_card(document: Mapping[str, Any]) -> str:
    """Model card of the pipeline that `document` describes: purpose, data, limits, in Markdown."""
    layout, targets, method = (document[name] for name in ("layout", "estimates", "method"))
    sensor = f"the one sensor it was recorded from, {layout['channels']} measurements"
    if method != POSITIONS:
        outline = from_dict(SensorDesign, layout["design"], "layout.design").outline
        sensor = (
            f"a {outline.length * 1e3:g} x {outline.width * 1e3:g} mm sensor with "
            f"{layout['protocol']['n_electrodes']} electrodes, {layout['channels']}\nmeasurements"
        )
    estimates = {
        f"the state ({' or '.join(targets['states'])})": bool(targets["states"]),
        "the bend angle in degrees": targets["angle"],
        "positions of touches in metres from the corner of the conductive layer": targets[
            "touches"
        ],
        "their forces in newtons": targets["force"],
    }
    limits = POSITION_LIMITS if method == POSITIONS else FLAT_LIMITS
    return CARD_TEXT.format(
        code=f"the code of {method}" if ":" in method else "no other code",
        sensor=sensor,
        frequency=f" at {layout['frequency'] / 1e3:g} kHz" if layout["frequency"] else "",
        estimates=", ".join(words for words, estimated in estimates.items() if estimated),
        frames=document["trained_on"]["frames"],
        source=document["trained_on"]["source"],
        method=method,
        limits=ANGLE_LIMITS if targets["angle"] else limits,
        metrics=json.dumps(document["metrics"], indent=1),
    )
