"""Cramer-Rao bounds of a press on a grid of positions over the sheet.

Derivatives by place and force are central differences of solved scenes (`Simulator.measure_all`): a
press of 10 N changes the conductivity beneath it by so much that the first order of the adjoint
sensitivity misses the signal altogether. The derivative by the angle is that of the sheet without
the press. docs/results/simulator.md gives bounds.
"""

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.folder import make_folder
from eitskin.datasets.store.worker_processes import run_tasks
from eitskin.files import remove_leftovers, write_file
from eitskin.geometry import Bend, ConfigurationError, SensorDesign
from eitskin.simulator import Instrument, Protocol, Scene, Simulator, Touch
from eitskin.simulator.electrical.resolution import Resolution, discretisation
from eitskin.simulator.instrument.ad5940 import MEASUREMENT_TIME
from eitskin.training.evaluation.cramer_rao import (
    FORCE_STEP,
    PLACE_STEP,
    SceneDerivatives,
    scene_derivatives,
)
from eitskin.training.method.input_spec import mirrors

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

FORCE = 10.0  # of the press [N]
_VERSION = 1  # of what a stored file means; raised when the calculation changes
_COMPARED_VALUES = 15  # singular values: further ones depend on how many places there are
_PAD_ORDERS = (2, 2, 2)  # from a pad currents spread in height as they do in the plane
_STENCIL = ((-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1))


@dataclass(frozen=True, slots=True)
class Layout:
    """Electrode layout of a bent sensor, of which every pair is measured.

    Attributes:
        name: name of the layout, for tables; says nothing about it.
        design: the sensor.
        angle_deg: angle of the bend at which it is tested [deg].
    """

    name: str
    design: SensorDesign
    angle_deg: float = 0.0

    @property
    def protocol(self) -> Protocol:
        """Protocol that measures all pairs."""
        return Protocol.pairwise(len(self.design.electrodes))

    @property
    def scan_time(self) -> float:
        """Time from one frame to the next [s]."""
        return len(self.protocol) * MEASUREMENT_TIME


@dataclass(frozen=True, slots=True)
class Sampling:
    """Grid of positions and mesh that a layout is tested with.

    Attributes:
        spacing: spacing of the places, at most [m].
        margin: margin without places [m]: presses nearer to the rim are detected by images only.
        resolution: resolution of the forward model.
        snr_db: signal-to-noise ratio of the instrument, its full scale over its white noise [dB].
    """

    spacing: float = 0.005
    margin: float = 0.0075
    resolution: Resolution = "fast"
    snr_db: float = 75.0

    def grid(self, design: SensorDesign) -> tuple[Array, Array]:
        """Coordinates x and y of the grid [m], symmetric about the middle of the sheet."""
        return self._line(design.outline.length), self._line(design.outline.width)

    def _line(self, extent: float) -> Array:
        room = extent - 2.0 * self.margin
        if not (self.spacing > 0.0 and room > 0.0):
            raise ConfigurationError(
                f"places {self.spacing:g} m apart and {self.margin:g} m from the rim do not fit on "
                f"{extent:g} m"
            )
        return self.margin + np.linspace(0.0, room, math.ceil(room / self.spacing - 1e-9) + 1)


Question = tuple[Layout, Sampling]
Judge = Callable[[Sequence[Question]], "list[SheetBound]"]
Watch = Callable[[str], None]


@dataclass(frozen=True, slots=True, eq=False)
class SheetBound:
    """Bounds of one press of 10 N on a sheet, from one frame against a reference of one frame.

    Attributes:
        x, y: lines of the places (nx,), (ny,) [m].
        place: sqrt(var x + var y) with the angle of the bend unknown (ny, nx) [m].
        place_known: the same with the angle known.
        force: angle unknown (ny, nx) [N].
        angle_deg: angle of the bend, next to the press (ny, nx) [deg].
        signal: norm of the change by the press, in deviations of the noise (ny, nx).
        untouched_deg: bound of the angle of the untouched sheet [deg].
        full_scale: largest resistance of the flat, untouched sheet [ohm].
        spectrum: singular values of all signals, rms over the places, in deviations of the noise,
            falling; as many as there are measurements, or places.
    """

    x: Array
    y: Array
    place: Array
    place_known: Array
    force: Array
    angle_deg: Array
    signal: Array
    untouched_deg: float
    full_scale: float
    spectrum: Array

    @property
    def uniformity(self) -> float:
        """Uniformity of the signal: 10th over 90th percentile."""
        weak, strong = np.percentile(self.signal, (10, 90))
        return float(weak / strong)

    @property
    def condition(self) -> float:
        """Condition number: largest over 15th singular value, the last of six electrodes."""
        return float(self.spectrum[0] / self.spectrum[:_COMPARED_VALUES][-1])

    @property
    def patterns(self) -> int:
        """Number of singular values of the signals above the noise of a frame."""
        return int((self.spectrum > 1.0).sum())


def sheet_bound(layout: Layout, sampling: Sampling) -> SheetBound:
    """Bounds over the sheet, solved in the part that the mirrors of the layout do not repeat.

    Raises ConfigurationError, naming the layout, where its measurements do not determine a press.
    """
    orders, grading = discretisation(sampling.resolution, layout.design, "hexahedra")
    if any(electrode.on != "side" for electrode in layout.design.electrodes):
        orders = _PAD_ORDERS
    sim = Simulator(layout.design, (orders, grading))
    x, y = sampling.grid(layout.design)
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    symmetries = mirrors(layout.design, layout.protocol)
    numbers, turned = np.arange(len(places)).reshape(len(y), len(x)), slice(None, None, -1)
    images = np.array(
        [
            numbers[turned if flip_y else slice(None), turned if flip_x else slice(None)].ravel()
            for flip_x, flip_y in (symmetry.flips for symmetry in symmetries)
        ]
    )
    first = images.min(axis=0)
    solved = np.unique(first)
    instrument, full_scale = Instrument(snr_db=sampling.snr_db), sim.full_scale
    untouched = scene_derivatives(sim, Scene(Bend(layout.angle_deg)))
    noise = untouched.noise(instrument, full_scale)
    rows, white = [], []
    try:
        alone = untouched.bound(noise)
        for found in touch_derivatives(sim, untouched, layout.angle_deg, places[solved]):
            own_noise = found.noise(instrument, full_scale)
            least, known = found.bound(own_noise), found.bound(own_noise, angle_known=True)
            white.append(np.log(np.abs(found.resistance / untouched.resistance)) / noise)
            signal = float(np.linalg.norm(white[-1]))
            row = least.place[0], known.place[0], least.force[0], least.angle_deg, signal
            rows.append(row)
    except ConfigurationError as error:
        raise ConfigurationError(f"layout '{layout.name}': {error}") from error
    maps = np.array(rows)[np.searchsorted(solved, first)].T.reshape(-1, len(y), len(x))
    whole = np.empty((len(places), len(noise)))
    for image, symmetry in zip(images, symmetries, strict=True):
        whole[np.ix_(image[solved], symmetry.order)] = white
    spectrum: Array = np.asarray(np.linalg.svd(whole / math.sqrt(len(places)), compute_uv=False))
    place, place_known, force, angle, change = maps
    return SheetBound(
        x, y, place, place_known, force, angle, change, alone.angle_deg, full_scale, spectrum
    )


def touch_derivatives(
    sim: Simulator, untouched: SceneDerivatives, angle_deg: float, places: Array
) -> list[SceneDerivatives]:
    """Derivatives at a press of 10 N at each position (n, 2) [m], and by the untouched angle."""
    step = np.array([PLACE_STEP, PLACE_STEP, FORCE_STEP * FORCE])
    moved = np.array([(x, y, FORCE) for x, y in places])[:, None] + np.array(_STENCIL) * step
    scenes = [
        Scene(Bend(angle_deg), (Touch(x, y, force),))
        for x, y, force in moved.reshape(-1, 3).tolist()
    ]
    resistance = sim.measure_all(scenes).real.reshape(len(places), 3, 2, -1)
    logarithms = np.log(np.abs(resistance))
    slopes = (logarithms[:, :, 1] - logarithms[:, :, 0]) / (2.0 * step[:, None])
    pressed = resistance[:, 2].mean(axis=1)
    return [
        SceneDerivatives(level, slope[None], untouched.by_angle)
        for level, slope in zip(pressed, slopes, strict=True)
    ]


def judge_layouts(
    folder: Path, workers: int, watch: Watch, questions: Sequence[Question]
) -> list[SheetBound]:
    """Bounds of layouts in order; questions that differ only in the layout's name share one.

    Each is a small file in `folder`, named by a hash of what was asked: a run that was stopped
    goes on. One worker is this process; `watch` is called with each layout that is finished.

    Raises PartialError where a file cannot be written or a process died; run again to go on.
    """
    make_folder(folder)
    remove_leftovers(folder)
    by_path = {_path(folder, question): question for question in questions}
    missing = [(path, question) for path, question in by_path.items() if _read(path) is None]
    for path, question in by_path.items():
        if (path, question) not in missing:
            watch(question[0].name)
    for (_, question), _ in run_tasks(_write, missing, workers if workers > 1 else 0):
        watch(question[0].name)
    bounds = (_read(_path(folder, question)) for question in questions)
    return [bound for bound in bounds if bound is not None]


def _path(folder: Path, question: Question) -> Path:
    layout, sampling = question
    asked = {"version": _VERSION, "force": FORCE, "angle_deg": layout.angle_deg}
    content = msgspec.json.encode(
        asked | {"design": layout.design.to_toml()} | asdict(sampling), order="sorted"
    )
    return folder / f"{hashlib.sha256(content).hexdigest()[:20]}.json"


def _read(path: Path) -> SheetBound | None:
    """Bound stored in a file; None where it is missing or damaged."""
    try:
        content = path.read_bytes()
        return msgspec.json.decode(content, type=SheetBound, dec_hook=lambda _, v: np.array(v))
    except (OSError, msgspec.MsgspecError):
        return None


def _write(task: tuple[Path, Question]) -> None:
    path, question = task
    bound = sheet_bound(*question)
    write_file(path, msgspec.json.encode(bound, enc_hook=lambda array: array.tolist()) + b"\n")
