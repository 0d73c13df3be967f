"""Frames of a recording by what they show: the flat sensor, known bends, known touches."""

import dataclasses
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.schema import UNKNOWN_STATE, State
from eitskin.errors import ConfigurationError, DataError
from eitskin.frame import Status
from eitskin.geometry.deformation.fixtures import Bend
from eitskin.protocol import Protocol
from eitskin.simulator.instrument.meter import Quantity
from eitskin.simulator.instrument.meter_fit import white_noise
from eitskin.simulator.scene.indenters import Cylinder
from eitskin.simulator.scene.scene import Scene, Touch

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Frames = dict[Scene, list[Array]]

KINDS = ("flat", "bend", "touch")
FLAT = Scene()
MOST_SCENES = 40
"""Different bends, and different touches, that are fitted; of more, evenly spaced ones."""


@dataclass(frozen=True, slots=True, eq=False)
class LabelledFrames:
    """Means of the frames of known scenes, as changes from untouched ones; n rows, C channels.

    Attributes:
        protocol: of the frames.
        reads: what the readings are.
        scenes: all scenes of the rows, the flat sensor first.
        shown: number of the scene that each row shows, (n,).
        base: number of the scene that each row is the change from, (n,); -1 for the flat sensor's
            own row, the first, which is absolute.
        kind: of each row, a number in `KINDS`, (n,).
        values: readings or their changes, (n, C).
        variance: of each row's values over that of one reading, (n,).
        noise: standard deviation of one reading; 0 where there are too few frames to tell.
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

    def count(self, kind: str) -> int:
        """Number of rows of a kind."""
        return int((self.kind == KINDS.index(kind)).sum())

    def only_flat(self) -> "LabelledFrames":
        """The flat sensor's row alone."""
        one = slice(0, 1)
        return dataclasses.replace(
            self,
            scenes=self.scenes[one],
            shown=self.shown[one],
            base=self.base[one],
            kind=self.kind[one],
            values=self.values[one],
            variance=self.variance[one],
        )

    def changes(self, readings: Array) -> Array:
        """Rows (n, C) that belong to readings of the scenes, (scenes, C)."""
        from_base = np.where(self.base[:, None] < 0, 0.0, readings[self.base])
        return np.asarray(readings[self.shown] - from_base)


def labelled_frames(data: Dataset, most: int = MOST_SCENES) -> LabelledFrames:
    """Labelled frames of one sensor.

    Frames before touches (`touch_reference`) count as untouched frames of their own; a touch is
    then the change from the frame before it, which slow drifts leave alone. A touch whose bend is
    nowhere told is one of the flat sensor. Where nothing is labelled all frames are flat.

    Args:
        data: of one specimen.
        most: number of different bends, and of different touches, beyond which evenly spaced ones
            are taken.

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
    known = [(row, scene) for row, scene in _scenes(data) if scene is not None]
    untouched = _untouched(data, known, reads)
    touched, alone = _touched(data, known, reads, untouched)
    if FLAT not in untouched:
        raise DataError(
            "expected frames of the flat, untouched sensor, got none that is known to be; record "
            "the untouched sensor, or name the values before touches with --values"
        )
    flat = np.array(untouched[FLAT])
    bends = _spaced((scene for scene in untouched if scene != FLAT), most)
    touches = _spaced(touched, most)
    scenes = tuple(dict.fromkeys([FLAT, *bends, *map(_bare, touches), *touches]))
    number = {scene: k for k, scene in enumerate(scenes)}
    level = flat.mean(axis=0)
    shown = [FLAT, *bends, *touches]
    return LabelledFrames(
        protocol=data.protocol,
        reads=reads,
        scenes=scenes,
        shown=np.array([number[scene] for scene in shown]),
        base=np.array([-1, *(0 for _ in bends), *(number[_bare(scene)] for scene in touches)]),
        kind=np.repeat([0, 1, 2], [1, len(bends), len(touches)]),
        values=np.array(
            [
                level,
                *(np.mean(untouched[scene], axis=0) - level for scene in bends),
                *(np.mean(touched[scene], axis=0) for scene in touches),
            ]
        ),
        variance=np.array(
            [
                1.0 / len(flat),
                *(1.0 / len(untouched[scene]) + 1.0 / len(flat) for scene in bends),
                *(2.0 / len(touched[scene]) for scene in touches),
            ]
        ),
        noise=white_noise(flat),
        frames=len(known) - alone,
        left_out=len(data) - len(known) + alone,
    )


def _untouched(data: Dataset, known: list[tuple[int, Scene]], reads: Quantity) -> Frames:
    """Frames of the untouched sensor by its bend, those before touches among them."""
    found: Frames = {}
    frames, before = _real(data.impedance, reads), _real(data.touch_reference, reads)
    for row, scene in known:
        if np.isfinite(before[row]).all():
            found.setdefault(_bare(scene), []).append(before[row])
        if not scene.touches:
            found.setdefault(scene, []).append(frames[row])
    return found


def _touched(
    data: Dataset, known: list[tuple[int, Scene]], reads: Quantity, untouched: Frames
) -> tuple[Frames, int]:
    """Changes of the readings by each touch, and the number of touches without untouched frame."""
    found: Frames = {}
    alone = 0
    frames, before = _real(data.impedance, reads), _real(data.touch_reference, reads)
    for row, scene in known:
        if not scene.touches:
            continue
        bare = untouched.get(_bare(scene))
        if bare is None:
            alone += 1
            continue
        own = np.isfinite(before[row]).all()
        found.setdefault(scene, []).append(
            frames[row] - (before[row] if own else np.mean(bare, axis=0))
        )
    return found, alone


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
    found = []
    for k in np.flatnonzero(np.isfinite(data.touch_x[row])):
        x, y, force, depth, radius = (
            float(str(getattr(data, f"touch_{name}")[row, k]))  # 0.0075, not its nearest binary
            for name in ("x", "y", "force", "depth", "radius")
        )
        tip = Cylinder(radius) if np.isfinite(radius) else Cylinder()
        if np.isfinite(force):
            if force > 0.0:
                found.append(Touch(x, y, force, tip))
        elif np.isfinite(depth) and depth > 0.0:
            found.append(Touch(x, y, indenter=tip, depth=depth))
        else:
            return None
    return tuple(found)


def _bare(scene: Scene) -> Scene:
    """The scene without its touches."""
    return Scene(bend=scene.bend)


def _spaced(scenes: Iterable[Scene], most: int) -> list[Scene]:
    """At most so many of the scenes, evenly spaced."""
    found = list(scenes)
    if len(found) <= most:
        return found
    return [found[k] for k in np.linspace(0, len(found) - 1, most).round().astype(int)]


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
