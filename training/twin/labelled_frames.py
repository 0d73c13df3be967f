"""Frames of a recording by what they show: the flat sensor, known bends, known touches."""

import dataclasses
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets import UNKNOWN_STATE, Dataset, State
from eitskin.geometry import Bend, ConfigurationError, DataError
from eitskin.simulator import Cylinder, Protocol, Scene, Status, Touch
from eitskin.simulator.instrument.instrument import white_noise
from eitskin.simulator.instrument.meter import Quantity

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Frames = defaultdict[Scene, list[Array]]

KINDS = ("flat", "bend", "touch")
FLAT = Scene()
MAX_SCENES = 40
"""Different bends, and different touches, that are fitted; of more, evenly spaced ones."""


@dataclass(frozen=True, slots=True, eq=False)
class LabelledFrames:
    """Means of the frames of known scenes, as changes from untouched ones; n rows, C channels.

    Attributes:
        protocol: protocol of the frames.
        reads: kind of the readings.
        scenes: all scenes of the rows, the flat sensor first.
        shown: number of the scene that each row shows, (n,).
        base: number of the scene that each row is the change from, (n,); -1 for the flat sensor's
            own row, the first, which is absolute.
        kind: kind of each row, a number in `KINDS`, (n,).
        values: readings or their changes, (n, C).
        variance: variance of each row's values over that of one reading, (n,).
        noise: standard deviation of one reading; 0 where there are too few frames to show.
        frames: number of frames used.
        left_out: number of frames without the labels that a fit needs.
    """

    protocol: Protocol
    reads: Quantity
    scenes: tuple[Scene, ...]
    shown: Integers
    base: Integers
    kind: Integers
    values: Array
    variance: Array
    noise: float
    frames: int
    left_out: int

    @property
    def kind_masks(self) -> dict[str, NDArray[np.bool_]]:
        """Masks of the rows (n,) of each kind that occurs, by its name, in the order of `KINDS`."""
        return {name: self.kind == k for k, name in enumerate(KINDS) if (self.kind == k).any()}

    def only_flat(self) -> "LabelledFrames":
        """The flat sensor's row alone."""
        first_row = slice(0, 1)
        return dataclasses.replace(
            self,
            scenes=self.scenes[first_row],
            shown=self.shown[first_row],
            base=self.base[first_row],
            kind=self.kind[first_row],
            values=self.values[first_row],
            variance=self.variance[first_row],
        )

    def changes(self, readings: Array) -> Array:
        """Rows (n, C) that belong to readings of the scenes, (scenes, C)."""
        from_base = np.where(self.base[:, None] < 0, 0.0, readings[self.base])
        return np.asarray(readings[self.shown] - from_base)


def labelled_frames(data: Dataset) -> LabelledFrames:
    """Labelled frames of one sensor.

    Frames before touches (`touch_reference`) count as untouched frames of their own; a touch is
    then the change from the frame before it, which slow drifts leave alone. A touch whose bend is
    nowhere reported is one of the flat sensor. Where nothing is labelled all frames are flat.
    Beyond `MAX_SCENES` different bends, or touches, evenly spaced ones are taken.

    Raises:
        ConfigurationError: for frames without protocol, or of several specimens.
        DataError: where no frame shows the flat, untouched sensor.
    """
    if data.protocol is None:
        raise ConfigurationError(
            "the recording does not say which electrodes its channels drive and sense; give "
            "--protocol"
        )
    if (specimens := len(np.unique(data.specimen))) > 1:
        raise ConfigurationError(
            f"a twin is of one sensor, got {specimens} specimens; choose one with --specimen"
        )
    reads = _quantity(data)
    frames, before = _real(data.impedance, reads), _real(data.touch_reference, reads)
    scene_rows = [(row, scene) for row, scene in _scenes(data) if scene is not None]
    has_own = data.has_touch_reference
    untouched: Frames = defaultdict(list)
    touched: Frames = defaultdict(list)
    for row, scene in scene_rows:
        if has_own[row]:
            untouched[_bare(scene)].append(before[row])
        if not scene.touches:
            untouched[scene].append(frames[row])
    alone = 0
    for row, scene in scene_rows:
        if scene.touches and _bare(scene) in untouched:
            own = before[row] if has_own[row] else np.mean(untouched[_bare(scene)], axis=0)
            touched[scene].append(frames[row] - own)
        else:
            alone += bool(scene.touches)
    if FLAT not in untouched:
        raise DataError(
            "expected frames of the flat, untouched sensor, got none that is known to be; record "
            "the untouched sensor, or name the values before touches with --values"
        )
    flat = np.array(untouched[FLAT])
    bends, touches = (
        [own[k] for k in evenly_spaced(len(own), MAX_SCENES)]
        for own in ([scene for scene in untouched if scene != FLAT], list(touched))
    )
    scenes = tuple(dict.fromkeys([FLAT, *bends, *map(_bare, touches), *touches]))
    number = {scene: k for k, scene in enumerate(scenes)}
    level = flat.mean(axis=0)
    rows: list[tuple[Scene, int, Array, float]] = [(FLAT, -1, level, 1.0 / len(flat))]
    for scene in bends:
        seen = untouched[scene]
        rows.append((scene, 0, np.mean(seen, axis=0) - level, 1.0 / len(seen) + 1.0 / len(flat)))
    for scene in touches:
        seen = touched[scene]
        rows.append((scene, number[_bare(scene)], np.mean(seen, axis=0), 2.0 / len(seen)))
    shown, base, values, variance = zip(*rows, strict=True)
    return LabelledFrames(
        protocol=data.protocol,
        reads=reads,
        scenes=scenes,
        shown=np.array([number[scene] for scene in shown]),
        base=np.array(base),
        kind=np.repeat([0, 1, 2], [1, len(bends), len(touches)]),
        values=np.array(values),
        variance=np.array(variance),
        noise=white_noise(flat),
        frames=len(scene_rows) - alone,
        left_out=len(data) - len(scene_rows) + alone,
    )


def _scenes(data: Dataset) -> Iterator[tuple[int, Scene | None]]:
    """Scene of each frame; None where its labels do not say enough."""
    lost = (data.status & np.uint8(Status.NOT_FINITE)).astype(bool)
    finite = np.asarray(~lost.any(axis=1))
    bent = np.isfinite(data.bend_angle_deg)
    unlabelled = (data.state == UNKNOWN_STATE).all() and not data.touch_count.any()
    for row in range(len(data)):
        state, touches = int(data.state[row]), _touches(data, row)
        if touches is None or not finite[row] or (state == State.TOUCH and not touches):
            yield row, None
        elif bent[row]:
            yield row, Scene(bend=Bend(float(data.bend_angle_deg[row])), touches=touches)
        elif touches or state == State.IDLE or (unlabelled and not bent.any()):
            yield row, Scene(touches=touches)
        else:
            yield row, None


def _touches(data: Dataset, row: int) -> tuple[Touch, ...] | None:
    """Touches of a frame; None where a force or depth is missing."""
    touches = []
    for k in np.flatnonzero(np.isfinite(data.touch_x[row])):
        x, y, force, depth, radius = (
            float(str(getattr(data, f"touch_{name}")[row, k]))  # 0.0075, not its nearest binary
            for name in ("x", "y", "force", "depth", "radius")
        )
        tip = Cylinder(radius) if np.isfinite(radius) else Cylinder()
        if np.isfinite(force):
            if force > 0.0:
                touches.append(Touch(x, y, force, tip))
        elif np.isfinite(depth) and depth > 0.0:
            touches.append(Touch(x, y, indenter=tip, depth=depth))
        else:
            return None
    return tuple(touches)


def _bare(scene: Scene) -> Scene:
    """The scene without its touches."""
    return Scene(bend=scene.bend)


def evenly_spaced(count: int, most: int) -> Integers:
    """At most so many of the numbers below a count, evenly spaced, (k,)."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.int64)


def _quantity(data: Dataset) -> Quantity:
    """Kind of the readings: a stated magnitude or impedance, else as the values look."""
    if data.quantity == "magnitude":
        return "magnitude"
    if data.quantity == "impedance":
        return "signed"
    return "signed" if (data.impedance.real < 0.0).any() else "magnitude"


def _real(values: NDArray[np.complex64], reads: Quantity) -> Array:
    """Readings as real numbers, (frames, channels)."""
    wide = values.astype(np.complex128)
    return np.asarray(np.abs(wide) if reads == "magnitude" else wide.real)
