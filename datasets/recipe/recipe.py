"""Recipe of a dataset: sensor, specimens, scenes, episodes, instrument and seed."""

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from eitskin.config import Location, read, read_toml, to_toml
from eitskin.datasets.recipe import SHIPPED_FOLDER, shipped_names
from eitskin.datasets.recipe.episode import Episodes
from eitskin.datasets.recipe.scene_group import SceneGroup, count_problems, refusal
from eitskin.datasets.recipe.specimen import SPREAD_LOADS, Mounts, Specimen, Specimens
from eitskin.datasets.store.schema import AVERAGED, LIMITS, MAX_AVERAGED_FRAMES
from eitskin.errors import ConfigurationError
from eitskin.extras import old_names
from eitskin.geometry.deformation.fixtures import Bend, Clamp, Fixture, FreeArc, Hinge
from eitskin.geometry.design.dispersion import FREQUENCY
from eitskin.geometry.design.outline import PlaneOutline
from eitskin.geometry.design.sensor import SensorDesign, Support, require_fit
from eitskin.geometry.design.surface import Surface
from eitskin.protocol import Protocol
from eitskin.simulator.bends import bend_table
from eitskin.simulator.bends.bend_table import ANGLES_DEG
from eitskin.simulator.deformation.sensor_grid import SensorGrid, with_grid
from eitskin.simulator.electrical.resolution import Resolution
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.scene.scene import require_bendable

MAX_FRAMES = 10**9
MAX_SHARDS = 10**6
_ROLL_MESSAGE = (
    "a rolled sensor needs a kinematic fixture, got clamps; give fixture = { length = 0.1 } for a "
    "free arc, or a hinge, and no mounts"
)


@old_names(expanded="expand_data", shipped="from_shipped")
@dataclass(frozen=True, slots=True)
class Recipe:
    """Full description of a dataset; equal recipes make equal datasets.

    Attributes:
        name: short name.
        scenes: groups of scenes, interleaved; each frame is a snapshot without before and after.
        episodes: time series, after the scenes, one entry after the other.
        seed: seed of everything random.
        description: one sentence for readers.
        resolution: resolution of the simulator.
        frames_per_shard: number of frames in a file, which one worker simulates. Episodes are not
            split: a shard has as many as fit, at least one.
        sensor: nominal design. In TOML also "reference" or the path of a design file.
        protocol: table of measurements; all pairs of electrodes when omitted. In TOML also a text
            for `Protocol.from_name`, as "adjacent" or "table.csv".
        fixture: device that bends the sensor; the default clamp when omitted.
        mechanics: materials of gel and encapsulation.
        grid: nominal values about which touches and bends are solved; the design's when omitted.
        instrument: errors and noise of the board; each specimen has one board and one session.
            Boards differ by `board_loads` of `specimens`.
        specimens: number of sensors and standard deviations between them.
        mounts: clamps and stiffnesses that specimens have in turn, instead of `fixture`.
        frequency: frequency of the excitation [Hz]; 40 kHz when omitted.
        reference_frames: number of noisy untouched frames averaged for a `touch_reference`.
        touch_frames: the same for a touched frame of `scenes`.

    Example:
        >>> from eitskin import Recipe
        >>> Recipe.from_shipped("quick").frames
        3000
    """

    name: str
    scenes: tuple[SceneGroup, ...] = ()
    episodes: tuple[Episodes, ...] = ()
    seed: int = 0
    description: str = ""
    resolution: Resolution = "fast"
    frames_per_shard: int = 256
    sensor: SensorDesign = field(default_factory=SensorDesign.reference)
    protocol: Protocol | None = None
    fixture: Fixture = field(default_factory=Clamp)
    mechanics: Mechanics = field(default_factory=Mechanics)
    grid: SensorGrid | None = None
    instrument: Instrument = field(default_factory=Instrument)
    specimens: Specimens = field(default_factory=Specimens)
    mounts: Mounts = field(default_factory=Mounts)
    reference_frames: int = 1
    touch_frames: int = 1
    frequency: float | None = None

    def __post_init__(self) -> None:
        """Check the recipe; the ConfigurationError lists everything that is wrong."""
        problems = list(dict.fromkeys(self._problems()))
        if problems:
            raise ConfigurationError(
                f"recipe '{self.name}' cannot be made:\n- " + "\n- ".join(problems)
            )

    @classmethod
    def from_toml(cls, path: str | Path) -> "Recipe":
        """Read a recipe; raises ConfigurationError for anything that does not fit."""
        return read_toml(cls, path)

    @classmethod
    def from_shipped(cls, name: str) -> "Recipe":
        """Recipe that ships with eitskin, by name; see `shipped_names`."""
        if name not in shipped_names():
            raise ConfigurationError(
                f"there is no shipped recipe '{name}'; shipped are {', '.join(shipped_names())}. "
                "For a recipe of your own, give the path of its .toml file"
            )
        return cls.from_toml(SHIPPED_FOLDER / f"{name}.toml")

    @classmethod
    def expand_data(cls, data: Mapping[str, Any], location: Location) -> Mapping[str, Any]:
        """TOML table `data` with the sensor and protocol that it names, and in today's form.

        The hinge of version 0.1 is a fixture; the grid of version 0.2 stood in the fixture and in
        the mechanics.
        """
        if "hinge" in data and "fixture" in data:
            raise location.error("expected `fixture` or `hinge`, got both; leave `hinge` out")
        table = with_grid({key: value for key, value in data.items() if key != "hinge"})
        if "hinge" in data:
            table["fixture"] = read(Hinge, data["hinge"], location.child("hinge"))
        if "sensor" in data:
            table["sensor"] = _sensor(data["sensor"], location.child("sensor"))
        if isinstance(data.get("protocol"), str):
            design = table.get("sensor", SensorDesign.reference())
            folder = location.folder or Path()
            table["protocol"] = Protocol.from_name(data["protocol"], len(design.electrodes), folder)
        return table

    @property
    def measured_protocol(self) -> Protocol:
        """Protocol of all frames: `protocol`, or all pairs of electrodes."""
        return self.protocol or Protocol.pairwise(len(self.sensor.electrodes))

    @property
    def quantity(self) -> str:
        """Kind of the values, as `Dataset.quantity`."""
        return "magnitude" if self.instrument.reads == "magnitude" else "impedance"

    def to_toml(self) -> str:
        """The recipe as TOML that needs no other file; `from_toml` of it is this recipe."""
        return to_toml(self)

    @property
    def outline(self) -> PlaneOutline:
        """Plane outline of the sensor; raises ConfigurationError for a surface."""
        outline = self.sensor.outline
        if isinstance(outline, Surface):
            raise ConfigurationError(
                "sensor: bending and touches need a rectangle, disc or polygon as outline, not a "
                "surface; give the rim of a flat sensor as outline = { points = [...] }"
            )
        return outline

    def nominal(self, specimen: int) -> Specimen:
        """Sensor, fixture and materials from which a specimen deviates."""
        fixture, mechanics = self.fixture, self.mechanics
        if self.mounts.count:
            mount = specimen % self.mounts.count
            fixture, mechanics = self.mounts.clamp(mount), self.mounts.mechanics(mount, mechanics)
        own = SensorGrid.from_nominal(self.sensor, fixture, mechanics)
        return Specimen(self.nominal_sensor, fixture, mechanics, own.override(self.grid))

    @property
    def excitation_frequency(self) -> float:
        """Frequency of the excitation [Hz]."""
        return FREQUENCY if self.frequency is None else self.frequency

    @property
    def nominal_sensor(self) -> SensorDesign:
        """The sensor with its conductivities at the frequency of the excitation."""
        return self.sensor.resolve_frequency(self.excitation_frequency)

    @property
    def snapshots(self) -> int:
        """Number of frames of `scenes`, which come before the episodes."""
        return sum(group.frames for group in self.scenes)

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.snapshots + sum(episode.count * episode.frames for episode in self.episodes)

    @property
    def extreme_angles(self) -> tuple[float, float]:
        """Minimum and maximum bend of any frame [deg]; zeros without bends."""
        angles = [angle for group in self.scenes for angle in group.angle_deg]
        angles += [angle for episode in self.episodes for angle in episode.angles_deg]
        return min([*angles, 0.0]), max([*angles, 0.0])

    @property
    def shards(self) -> int:
        """Number of shards, which may differ in length."""
        return len(_shard_ranges(self))

    def shard_range(self, shard: int) -> range:
        """Numbers of the frames in `shard`."""
        return _shard_ranges(self)[shard]

    def _problems(self) -> Iterator[str]:
        if not self.name:
            yield "name must not be empty"
        if not 0 <= self.seed < 2**63:
            yield f"seed must be from 0 to 2^63 - 1, got {self.seed}"
        yield from count_problems("frames_per_shard", self.frames_per_shard, 1, LIMITS["frame"])
        for name in AVERAGED:
            yield from count_problems(name, getattr(self, name), 1, MAX_AVERAGED_FRAMES)
        if self.touch_frames > 1 and self.episodes:
            yield "touch_frames averages frames of scenes, got episodes, where each is a frame"
        yield from self._size_problems()
        yield from self._protocol_problems()
        if self.mounts.count and self.fixture != Clamp():
            yield "mounts take the place of the fixture, got both; leave one out"
        yield from self._specimen_problems()
        if not self.scenes and not self.episodes:
            yield "scenes or episodes must hold at least one group"
        try:
            outline = self.outline
        except ConfigurationError as error:
            yield str(error)
            return
        for number, group in enumerate(self.scenes):
            problems = [*group.problems(outline), *map(self._bend_problem, group.angle_deg)]
            if group.rolls and isinstance(self.fixture, Clamp):
                problems.append(_ROLL_MESSAGE)
            problems += self._support_problems(group.support, group.bends)
            for problem in filter(None, problems):
                yield f"scenes[{number}] ({group.state}): {problem}"
        for number, episode in enumerate(self.episodes):
            problems = list(episode.problems(outline))
            problems = problems or [*map(self._bend_problem, episode.angles_deg)]
            problems += self._skew_problems(episode.period)
            problems += self._support_problems(None, episode.angles_deg != (0.0, 0.0))
            for problem in filter(None, problems):
                yield f"episodes[{number}]: {problem}"

    def _support_problems(self, support: Support | None, bent: bool) -> Iterator[str]:
        """Reason why a support, or the sensor's, does not allow the bends of a group."""
        support = support or self.sensor.support
        bend = list(refusal(lambda: require_bendable(support, self.fixture))) if bent else []
        yield from bend or refusal(lambda: require_fit(support, self.sensor.outline))

    def _size_problems(self) -> Iterator[str]:
        if self.frames > MAX_FRAMES:
            yield f"scenes and episodes must have at most {MAX_FRAMES} frames, got {self.frames}"
        elif self.frames > MAX_SHARDS * self.frames_per_shard:
            yield (
                f"frames_per_shard must be at least {-(-self.frames // MAX_SHARDS)} for "
                f"{self.frames} frames, got {self.frames_per_shard}: a dataset has at most "
                f"{MAX_SHARDS} files"
            )

    def _specimen_problems(self) -> Iterator[str]:
        loads = [getattr(self.instrument.meter, name, 0.0) for name in SPREAD_LOADS]
        if self.specimens.board_loads and not any(loads):
            yield (
                "specimens: board_loads is the spread of the loads of the instrument's meter, got "
                "none there; give some, as instrument.meter = { source = 1.5e-5, sink = 1.5e-5 }"
            )
        impossible = list(self.mounts.problems())
        impossible = impossible or list(self.mounts.unclampable(self.sensor, self.mechanics))
        yield from impossible
        for fixture in (self.fixture,) if impossible else self._fixtures:
            yield from self.specimens.problems(self.sensor, fixture)

    @property
    def _fixtures(self) -> tuple[Fixture, ...]:
        """Fixtures of all mounts, or the one of the recipe."""
        return tuple(map(self.mounts.clamp, range(self.mounts.count))) or (self.fixture,)

    def _protocol_problems(self) -> Iterator[str]:
        electrodes = len(self.sensor.electrodes)
        if self.protocol is not None and self.protocol.n_electrodes != electrodes:
            yield (
                f"protocol is for {self.protocol.n_electrodes} electrodes, the sensor has "
                f"{electrodes}"
            )
        yield from refusal(lambda: self.nominal_sensor, "frequency: ")
        arguments = self.measured_protocol, 1.0, np.random.default_rng(0)
        yield from refusal(lambda: self.instrument.session(*arguments), "instrument: ")

    def _bend_problem(self, angle_deg: float) -> str:
        """Reason why the sensor or an extreme specimen cannot be bent so far; empty without one."""
        fixture = self.fixture
        if not isinstance(fixture, Clamp):
            return _kinematic_problem(self.sensor, fixture, self.specimens, angle_deg)
        if not angle_deg:
            return ""
        least, most = ANGLES_DEG[0], ANGLES_DEG[-1]
        if not least <= angle_deg <= most:
            return (
                f"a bend of {angle_deg:g} deg is beyond the clamp, which is solved from {least:g} "
                f"to {most:g} deg; bend less, or choose a kinematic fixture"
            )
        clamped = self.sensor, fixture, self.mechanics
        return "".join(refusal(lambda: bend_table.check_clamp(*clamped)))

    def _skew_problems(self, period: float) -> Iterator[str]:
        last = float(self.instrument.offsets(self.measured_protocol).max())
        if last > period:
            yield (
                f"period must be at least the {last:g} s that the instrument needs for a frame, "
                f"got {period:g} s"
            )


@lru_cache(maxsize=64)  # recipes have the same angles in most of their groups
def _kinematic_problem(
    sensor: SensorDesign, fixture: Hinge | FreeArc, specimens: Specimens, angle_deg: float
) -> str:
    """Reason why the sensor or an extreme specimen cannot be bent so far; empty without one."""

    def check() -> None:
        fixture.flexure(sensor, Bend(angle_deg))
        if not list(specimens.problems(sensor, fixture)):
            for design, own in specimens.extremes(sensor, fixture):
                own.flexure(design, Bend(angle_deg))

    return "".join(refusal(check))


@lru_cache(maxsize=16)
def _shard_ranges(recipe: Recipe) -> tuple[range, ...]:
    """Frames of each shard: first snapshots, then whole episodes."""
    pieces = [(recipe.snapshots, recipe.frames_per_shard)]
    for episode in recipe.episodes:
        together = max(1, recipe.frames_per_shard // episode.frames)
        pieces.append((episode.count * episode.frames, together * episode.frames))
    ranges, start = [], 0
    for frames, length in pieces:
        end = start + frames
        ranges += [range(first, min(first + length, end)) for first in range(start, end, length)]
        start = end
    return tuple(ranges)


def _sensor(value: Any, location: Location) -> SensorDesign:
    """Design in a recipe: a table, the path of a design file, or "reference"."""
    if isinstance(value, Mapping) and "file" in value:
        raise location.error(
            "a design file is named as sensor = \"PATH.toml\", got a table with the key 'file'"
        )
    if value == "reference":
        return SensorDesign.reference()
    if isinstance(value, str):
        return SensorDesign.from_toml((location.folder or Path()) / value)
    design: SensorDesign = read(SensorDesign, value, location)
    return design


def with_seed(recipe: Recipe, seed: int | None) -> Recipe:
    """Recipe with another seed, where one is given."""
    return recipe if seed is None else dataclasses.replace(recipe, seed=seed)
