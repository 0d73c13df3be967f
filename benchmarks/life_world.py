"""World of `bench life`: streams of frames on unseen sensors, each of one kind of event.

Scenes are solved on a coarse set of places, forces and angles, and what lies between is
interpolated. Contacts, leaks, the board's gain and noise are added to the solved circuits.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from eitskin.benchmarks.results import Progress
from eitskin.benchmarks.transfer import recipes
from eitskin.datasets.recipe.frame_sampling import instrument, specimen
from eitskin.errors import ConfigurationError
from eitskin.files import atomic_file
from eitskin.frame import Frame
from eitskin.geometry.deformation.fixtures import Bend, Twist
from eitskin.protocol import Protocol
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.scene.scene import Scene, Touch
from eitskin.simulator.simulator import Simulator

Array = NDArray[np.float64]
Matrices = NDArray[np.complex128]

SENSOR_GROUPS = ("as trained", "other clamps", "other stiffness", "rough electrodes", "other board")
"""Worlds of `bench transfer` that the sensors are of, in turn."""
OPENING = 12  # frames of the flat, untouched sensor before each event
HELD_FRAMES = 12  # frames that a touch is held for
PERIOD = 0.303  # s, from frame to frame
NOISE = (0.5, 3.0)  # range of the noise, in units of the instrument's, even in its logarithm
ANGLES = np.array([-20.0, -10.0, 0.0, 10.0, 20.0, 30.0, 40.0, 50.0])  # deg, that are solved
KNOWN_DEG = np.array([0.0, -20.0, 15.0, 30.0, 42.0, 50.0])  # that a sensor is calibrated with
FORCE = (4.0, 12.0)  # N, range of touches
FORCES = np.array([2.0, 4.0, 7.0, 10.0, 12.0])  # N, of the ramp that is solved
PATH = 0.060 * np.linspace(0.0, 1.0, 13)  # m, along a slide, that are solved
MARGIN = 0.010  # m, between touches and the edge
CLOSE = 0.0155  # m, between the nearest touches that can be solved
DISTANCES, RATIOS = (0.016, 0.022, 0.030, 0.040, 0.060), (1.0, 0.6, 1.0 / 3.0)
"""Distances [m] and ratios of forces of the pairs that resolution is mapped by."""
PAIR_FORCE = 10.0  # N, of the stronger touch of these
PAIR_ANGLES = (0.0, 30.0)  # deg, of bends that they are on
PAIR_FRAMES = 4  # flat ones, bent ones and those of the pair that count


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """Frames of one event on one sensor, without noise.

    Attributes:
        impedance: impedance of the electrodes (n, electrodes, electrodes) [ohm].
        touches: x [m], y [m] and force [N] (n, k, 3); NaN where absent.
        angle_deg: angle of the bend (n,) [deg].
        factor: factor of the board's readings (n,).
    """

    impedance: Matrices
    touches: Array
    angle_deg: Array
    factor: Matrices

    def frames(
        self,
        board: Instrument,
        protocol: Protocol,
        frequency: float,
        noise: float,
        seed: Sequence[int],
    ) -> list[Frame]:
        """Frames as a board reads them in one session, with `noise` times its white noise."""
        start, further = np.random.default_rng(seed).spawn(2)
        impedances = board.terminal_impedances(self.impedance, protocol)
        session = _with_noise(board, noise).session(
            protocol, float(np.abs(impedances[0, 0]).max()), start
        )
        times = PERIOD * np.arange(len(impedances), dtype=np.float64)
        values, status = session.measure(impedances, times, further)
        return [
            Frame(value, protocol, PERIOD * n, n, frequency=frequency, status=bits)
            for n, (value, bits) in enumerate(
                zip(values * self.factor[:, None], status, strict=True)
            )
        ]

    def signal(self, board: Instrument, protocol: Protocol, noise: float) -> Array:
        """Change of the readings by the touches (n,), in standard deviations of a frame's noise.

        Root of the sum of squares over the measurements, against the latest untouched frame; where
        the sensor has bent since, that of the last frame before. Infinite without touches.
        """
        V = np.abs(board.transfer_impedance(self.impedance, protocol))
        deviation = _with_noise(board, noise).deviation(float(V[0].max()))
        signal, untouched = np.full(len(V), np.inf), 0
        for n, angle in enumerate(self.angle_deg):
            if not np.isfinite(self.touches[n, :, 0]).any():
                untouched = n
            elif angle == self.angle_deg[untouched]:
                signal[n] = np.linalg.norm(V[n] - V[untouched]) / deviation
            else:
                signal[n] = signal[n - 1]
        return signal


def _with_noise(board: Instrument, noise: float) -> Instrument:
    """The board with `noise` times its white noise."""
    return replace(board, snr_db=board.snr_db - 20.0 * float(np.log10(noise)))


@dataclass(eq=False)
class Sensor:
    """One unseen sensor, and the random numbers of its events.

    Attributes:
        simulator: simulator of the sensor.
        rng: rng of its events.
        flat: electrode impedances of the flat, untouched sensor [ohm].
    """

    simulator: Simulator
    rng: np.random.Generator
    flat: Matrices = field(init=False)

    def __post_init__(self) -> None:
        """Solve the flat sensor."""
        self.flat = self.solve_scenes([Scene()])[0]

    def solve_scenes(self, scenes: list[Scene]) -> Matrices:
        """Electrode impedances of scenes (n, electrodes, electrodes) [ohm]."""
        return np.asarray(self.simulator.impedances(scenes), dtype=complex)

    def solve_touches(self, touches: ArrayLike, angle_deg: float = 0.0) -> Matrices:
        """Electrode impedances under touches (k, 3) of x [m], y [m] and force [N]."""
        pressing = tuple(Touch(*row) for row in np.asarray(touches).tolist())
        matrix: Matrices = self.solve_scenes([Scene(Bend(angle_deg), pressing)])[0]
        return matrix

    def solve_angles(self, angle_deg: ArrayLike) -> Matrices:
        """Electrode impedances at angles (n,) [deg]."""
        return np.asarray(self._bends(np.asarray(angle_deg)))

    @cached_property
    def _bends(self) -> CubicSpline:
        """Electrode impedances [ohm] by the angle [deg]."""
        return CubicSpline(
            ANGLES, self.solve_scenes([Scene(Bend(angle)) for angle in ANGLES.tolist()])
        )

    def places(self, count: int, least: float = 0.030, most: float = np.inf) -> Array:
        """Places (count, 2) [m], each at least and the nearest at most so far from others."""
        outline = self.simulator.design.outline
        size = np.array([outline.length, outline.width]) - MARGIN
        while True:
            places = self.rng.uniform(MARGIN, size, (count, 2))
            apart = np.linalg.norm(places[:, None] - places, axis=2)[np.triu_indices(count, 1)]
            if not len(apart) or least <= apart.min() <= most:
                return places

    def touches(self, count: int, least: float = 0.030, most: float = np.inf) -> Array:
        """Touches (count, 3) of x [m], y [m] and force [N], as `places`."""
        return np.column_stack([self.places(count, least, most), self.rng.uniform(*FORCE, count)])

    def stream(
        self,
        impedance: ArrayLike,
        touches: Array | None = None,
        angle_deg: ArrayLike = 0.0,
        factor: ArrayLike = 1.0,
    ) -> Stream:
        """The flat sensor for `OPENING` frames, then electrode impedances (n, ...) [ohm].

        Touches (k, 3) or (n, k, 3), angles and factors are those of the n frames.
        """
        event = np.asarray(impedance, dtype=complex)
        count = len(event)
        none = np.full(
            (OPENING, 1, 3) if touches is None else (OPENING, touches.shape[-2], 3), np.nan
        )
        all_touches = np.full((count, 1, 3), np.nan) if touches is None else touches
        all_touches = np.broadcast_to(all_touches, (count, *none.shape[1:]))
        angles, factors = (np.broadcast_to(each, count) for each in (angle_deg, factor))
        return Stream(
            np.concatenate([np.repeat(self.flat[None], OPENING, axis=0), event]),
            np.concatenate([none, all_touches]),
            np.concatenate([np.zeros(OPENING), angles]),
            np.concatenate([np.ones(OPENING), factors]).astype(complex),
        )

    def solve_flat(self, contacts: Array) -> Matrices:
        """The flat sensor with further resistances of its contacts (n, electrodes) [ohm]."""
        return np.asarray(self.flat + contacts[:, :, None] * np.eye(len(self.flat)))


def _held_touches(sensor: Sensor, touches: Array, angle_deg: float = 0.0) -> Stream:
    """Touches that are held."""
    pressed = np.repeat(sensor.solve_touches(touches, angle_deg)[None], HELD_FRAMES, axis=0)
    return sensor.stream(pressed, touches, angle_deg)


def _tap(sensor: Sensor) -> Stream:
    """A touch that is held and released."""
    touch = sensor.touches(1)
    matrices = np.repeat(
        [sensor.solve_touches(touch), sensor.flat], [HELD_FRAMES, HELD_FRAMES // 2], axis=0
    )
    rows = np.where(np.arange(len(matrices))[:, None, None] < HELD_FRAMES, touch, np.nan)
    return sensor.stream(matrices, rows)


def _taps(sensor: Sensor) -> Stream:
    """Touches of one frame each, with an untouched frame after every other."""
    touches = np.stack([sensor.touches(1) for _ in range(HELD_FRAMES)])
    matrices = np.array([sensor.solve_touches(touch) for touch in touches])
    after = np.arange(2, HELD_FRAMES + 1, 2)
    rows = np.insert(touches, after, np.nan, axis=0)
    return sensor.stream(np.insert(matrices, after, sensor.flat, axis=0), rows)


def _slide(sensor: Sensor, step: float) -> Stream:
    """A touch that slides along x by a step a frame [m]."""
    x, y, force = (*sensor.rng.uniform((0.020, 0.015), (0.070, 0.045)), sensor.rng.uniform(*FORCE))
    solved = np.array([sensor.solve_touches([[x + s, y, force]]) for s in PATH.tolist()])
    way = np.arange(0.0, PATH[-1] + 1e-9, step)
    way = np.concatenate([np.zeros(4), way[: 4 * HELD_FRAMES]])
    touches = np.stack([x + way, np.full_like(way, y), np.full_like(way, force)], axis=1)
    return sensor.stream(CubicSpline(PATH, solved)(way), touches[:, None])


def _ramp(sensor: Sensor) -> Stream:
    """A touch whose force falls from 12 to 2 N."""
    place = sensor.places(1)[0]
    solved = np.array([sensor.solve_touches([[*place, force]]) for force in FORCES.tolist()])
    forces = np.concatenate(
        [np.full(3, FORCES[-1]), np.linspace(FORCES[-1], FORCES[0], HELD_FRAMES)]
    )
    touches = np.column_stack([np.tile(place, (len(forces), 1)), forces])
    return sensor.stream(CubicSpline(FORCES, solved)(forces), touches[:, None])


def _pair(sensor: Sensor, ratio: tuple[float, float], apart: tuple[float, float]) -> Stream:
    """Two touches of a ratio of forces in a range, and of a distance in a range [m]."""
    touches = sensor.touches(2, *apart)
    touches[0, 2] = sensor.rng.uniform(8.0, 12.0)
    touches[1, 2] = touches[0, 2] * sensor.rng.uniform(*ratio)
    return _held_touches(sensor, touches)


def _cluster(sensor: Sensor, offsets: ArrayLike, force: tuple[float, float]) -> Stream:
    """Touches of equal forces at offsets (k, 2) [m] from a place, turned at random."""
    rows, outline = np.asarray(offsets, dtype=float), sensor.simulator.design.outline
    size = np.array([outline.length, outline.width])
    while True:
        turn = np.exp(1j * sensor.rng.uniform(0.0, 2.0 * np.pi)) * (rows @ [1.0, 1j])
        places = sensor.rng.uniform(0.0, size) + np.column_stack([turn.real, turn.imag])
        if (places >= MARGIN).all() and (places <= size - MARGIN).all():
            break
    return _held_touches(
        sensor, np.column_stack([places, np.full(len(rows), sensor.rng.uniform(*force))])
    )


def _bend(sensor: Sensor) -> Stream:
    """A bend at 3 deg a frame to an angle that is held."""
    largest = sensor.rng.choice([-1.0, 1.0, 1.0]) * sensor.rng.uniform(10.0, 20.0)
    largest *= 1.0 if largest < 0.0 else 2.3
    count = int(abs(largest) // 3.0)
    angles = np.concatenate(
        [np.linspace(0.0, largest, count + 1)[1:], np.full(HELD_FRAMES, largest)]
    )
    return sensor.stream(sensor.solve_angles(angles), angle_deg=angles)


def _held_on_bend(sensor: Sensor, touches: Array, angle_deg: float) -> Stream:
    """Touches (k, 3) on a sensor that was bent before."""
    angles = np.concatenate([np.linspace(0.0, angle_deg, 8)[1:], np.full(4, angle_deg)])
    pressed = np.repeat(sensor.solve_touches(touches, angle_deg)[None], HELD_FRAMES, axis=0)
    absent = np.full((len(angles), *touches.shape), np.nan)
    rows = np.concatenate([absent, np.tile(touches, (HELD_FRAMES, 1, 1))])
    matrices = np.concatenate([sensor.solve_angles(angles), pressed])
    return sensor.stream(matrices, rows, np.concatenate([angles, np.full(HELD_FRAMES, angle_deg)]))


def _bent_touch(sensor: Sensor) -> Stream:
    """A touch on a sensor that was bent before."""
    angle = sensor.rng.uniform(10.0, 40.0)
    return _held_on_bend(sensor, sensor.touches(1), angle)


def _pair_apart(sensor: Sensor, distance: float, ratio: float, angle_deg: float) -> Stream:
    """Two touches at a distance [m], the weaker of which has a share of the other's force."""
    touches = sensor.touches(2, distance, distance + 0.002)
    touches[:, 2] = PAIR_FORCE * np.array([1.0, ratio])
    stream, first = _held_on_bend(sensor, touches, angle_deg), OPENING - PAIR_FRAMES
    pressed = len(stream.angle_deg) - HELD_FRAMES
    chosen = [*range(first, OPENING), *range(pressed - PAIR_FRAMES, pressed + PAIR_FRAMES)]
    return Stream(*(getattr(stream, part)[chosen] for part in Stream.__slots__))


def _touch_then_bend(sensor: Sensor) -> Stream:
    """A touch that is held while the sensor bends at 3 deg a frame, then released."""
    touch, largest = sensor.touches(1), sensor.rng.uniform(15.0, 40.0)
    solved = np.array([sensor.solve_touches(touch, angle) for angle in ANGLES.tolist()])
    angles = np.concatenate([np.zeros(3), np.arange(0.0, largest, 3.0), np.full(4, largest)])
    released = np.repeat(sensor.solve_angles([largest]), 4, axis=0)
    rows = np.where(np.arange(len(angles) + 4)[:, None, None] < len(angles), touch, np.nan)
    matrices = np.concatenate([CubicSpline(ANGLES, solved)(angles), released])
    return sensor.stream(matrices, rows, np.concatenate([angles, np.full(4, largest)]))


def _contacts(sensor: Sensor, count: int, ohms: tuple[float, float]) -> Stream:
    """Contacts at random that change at once, each by a size in a range [ohm]."""
    added = np.zeros((HELD_FRAMES, len(sensor.flat)))
    which = sensor.rng.choice(added.shape[1], count, replace=False)
    added[:, which] = sensor.rng.uniform(*ohms, count)
    return sensor.stream(sensor.solve_flat(added))


def _ageing(sensor: Sensor) -> Stream:
    """Contacts that age, each at a rate of its own, then a touch."""
    rates = sensor.rng.uniform(0.0, 0.05, len(sensor.flat))
    touch, untouched = sensor.touches(1), 4 * HELD_FRAMES
    added = np.arange(1, untouched + HELD_FRAMES + 1)[:, None] * rates
    matrices = sensor.solve_flat(added)
    matrices[untouched:] += sensor.solve_touches(touch) - sensor.flat
    rows = np.where(np.arange(len(added))[:, None, None] < untouched, np.nan, touch)
    return sensor.stream(matrices, rows)


def _leak(sensor: Sensor, admittance: complex) -> Stream:
    """A leak of an admittance [S] between two electrodes."""
    first, second = sensor.rng.choice(len(sensor.flat), 2, replace=False)
    across = sensor.flat[:, first] - sensor.flat[:, second]
    share = admittance / (1.0 + admittance * (across[first] - across[second]))
    leaking = sensor.flat - share * np.outer(across, across)
    return sensor.stream(np.repeat(leaking[None], HELD_FRAMES, axis=0))


def _factor(sensor: Sensor, factor: complex) -> Stream:
    """A step of the board's gain or phase."""
    return sensor.stream(np.repeat(sensor.flat[None], HELD_FRAMES, axis=0), factor=factor)


def _draw_signed(sensor: Sensor, low: float, high: float) -> float:
    """A number whose magnitude is in a range, of either sign."""
    return float(sensor.rng.choice([-1.0, 1.0]) * sensor.rng.uniform(low, high))


@dataclass(frozen=True, slots=True)
class Event:
    """One kind of event.

    Attributes:
        make: a stream of it on a sensor.
        healthy: whether a problem would be unnecessary.
        known: whether an estimate of the touches and the angle can be right; else one without a
            problem is wrong, unless it is one touch about the middle of them.
        calibrated: whether the pipeline is calibrated to the sensor before.
    """

    make: Callable[[Sensor], Stream]
    healthy: bool = True
    known: bool = True
    calibrated: bool = False


_RING = [[0.0, 0.0], *([CLOSE * np.cos(a), CLOSE * np.sin(a)] for a in np.arange(6) * np.pi / 3)]
_TRIANGLE = np.array([[0.0, 0.0], [0.016, 0.0], [0.008, 0.0139]])
EVENTS: dict[str, Event] = {
    "idle": Event(lambda s: s.stream(np.repeat(s.flat[None], 2 * HELD_FRAMES, axis=0))),
    "touch, held and released": Event(_tap),
    "slide, 1 mm a frame": Event(lambda s: _slide(s, 0.001)),
    "slide, 2 mm a frame": Event(lambda s: _slide(s, 0.002)),
    "slide, 6 mm a frame": Event(lambda s: _slide(s, 0.006)),
    "slide, 15 mm a frame": Event(lambda s: _slide(s, 0.015)),
    "force from 12 to 2 N": Event(_ramp),
    "two touches, 30 to 60 mm": Event(lambda s: _pair(s, (0.8, 1.25), (0.030, 0.060))),
    "two uneven, 24 to 40 mm": Event(lambda s: _pair(s, (0.45, 0.7), (0.024, 0.040))),
    "two uneven, 16 to 24 mm": Event(lambda s: _pair(s, (0.45, 0.7), (CLOSE, 0.024)), False),
    "three touches": Event(lambda s: _held_touches(s, s.touches(3))),
    "four touches": Event(lambda s: _held_touches(s, s.touches(4))),
    "bend": Event(_bend),
    "touch on a bend": Event(_bent_touch),
    "bend, calibrated": Event(_bend, calibrated=True),
    "three touches, 16 mm": Event(lambda s: _cluster(s, _TRIANGLE, (4.0, 8.0)), False, False),
    "five touches": Event(lambda s: _held_touches(s, s.touches(5, 0.022)), False, False),
    "palm of 40 mm": Event(lambda s: _cluster(s, _RING, (2.0, 6.0)), False, False),
    "line of 64 mm": Event(
        lambda s: _cluster(s, [[CLOSE * k, 0.0] for k in range(5)], (3.0, 7.0)), False, False
    ),
    "twist": Event(
        lambda s: s.stream(
            np.repeat(
                s.solve_scenes([Scene(twist=Twist(_draw_signed(s, 5.0, 20.0)))]),
                HELD_FRAMES,
                axis=0,
            )
        ),
        False,
    ),
    "one contact": Event(lambda s: _contacts(s, 1, (2.0, 8.0)), False),
    "two contacts": Event(lambda s: _contacts(s, 2, (2.0, 8.0)), False),
    "three contacts": Event(lambda s: _contacts(s, 3, (2.0, 8.0)), False),
    "contacts that age": Event(_ageing, False),
    "leak of 100 kohm": Event(lambda s: _leak(s, 1e-5), False),
    "leak of 400 pF": Event(lambda s: _leak(s, 2j * np.pi * 40e3 * 400e-12), False),
    "step of the gain": Event(lambda s: _factor(s, 1.0 + _draw_signed(s, 0.001, 0.01)), False),
    "step of the phase": Event(
        lambda s: _factor(s, np.exp(1j * np.radians(_draw_signed(s, 1.0, 5.0)))), False
    ),
    "taps of one frame": Event(_taps),
    "touched, then bent": Event(_touch_then_bend),
}
REDRAWN = 20  # times at most
PAIRS = tuple(product(DISTANCES, RATIOS, PAIR_ANGLES))


@dataclass(frozen=True, slots=True, eq=False)
class SensorLife:
    """Streams of one sensor by their events, of pairs of touches, and frames of known angles."""

    world: str
    board: Instrument
    protocol: Protocol
    known: Stream
    streams: dict[str, Stream]
    pairs: dict[tuple[float, float, float], Stream]


def _draw(make: Callable[[Sensor], Stream], sensor: Sensor) -> Stream:
    """A stream, drawn again where its touches are deeper than a soft sensor is solved for."""
    for _ in range(REDRAWN):
        with suppress(ConfigurationError):
            return make(sensor)
    return make(sensor)


def lives(folder: Path, seed: int, count: int, progress: Progress) -> Iterator[SensorLife]:
    """Streams of sensors; those that `folder` does not have yet are solved."""
    for number in range(count):
        progress("streams", number, count)
        world = SENSOR_GROUPS[number % len(SENSOR_GROUPS)]
        recipe, mine = recipes(world, seed, quick=False)[0], number // len(SENSOR_GROUPS)
        board, path = instrument(recipe, mine), folder / f"streams-{seed}-{number}.npz"
        drawn_specimen = specimen(recipe, mine)
        if not path.is_file():
            parts = recipe.sensor, recipe.resolution, recipe.protocol
            rng = np.random.default_rng([seed, number])
            sensor = Sensor(drawn_specimen.simulator(*parts), rng)
            streams = {name: _draw(event.make, sensor) for name, event in EVENTS.items()}
            streams["known"] = sensor.stream(sensor.solve_angles(KNOWN_DEG), angle_deg=KNOWN_DEG)
            for distance, ratio, angle in PAIRS:
                apart = partial(_pair_apart, distance=distance, ratio=ratio, angle_deg=angle)
                streams[str((distance, ratio, angle))] = _draw(apart, sensor)
            with atomic_file(path) as temporary, temporary.open("wb") as file:
                np.savez_compressed(
                    file,
                    **{
                        f"{name}/{part}": getattr(stream, part)
                        for name, stream in streams.items()
                        for part in Stream.__slots__
                    },
                )
        with np.load(path) as arrays:
            stored = {
                name: Stream(*(arrays[f"{name}/{part}"] for part in Stream.__slots__))
                for name in ("known", *EVENTS, *map(str, PAIRS))
            }
        known_stream = stored.pop("known")
        pairs = {cell: stored.pop(str(cell)) for cell in PAIRS}
        protocol = recipe.protocol or Protocol.pairwise(len(drawn_specimen.design.electrodes))
        yield SensorLife(world, board, protocol, known_stream, stored, pairs)
    progress("streams", count, count)
