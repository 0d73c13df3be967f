"""Run of `bench transfer`: every pipeline in every world, by the labelled frames.

Sensors of a world differ from those of the recipe "training". A pipeline is scored as it is, and
adapted to each sensor by labelled frames.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.paper.scores import KNOWN_DEG, generate_missing
from eitskin.benchmarks.results import Columns, Progress, Report, ReportTable, make_results
from eitskin.datasets import Dataset, Recipe, State
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.datasets.recipe.specimen import Mounts
from eitskin.geometry import DataError, EitskinError, Plates, SensorDesign
from eitskin.simulator import FourTerminalMeter, Instrument
from eitskin.training import Pipeline, Predictions
from eitskin.training.evaluation.scores import Matches, root_mean_square

Array = NDArray[np.float64]
Figures = dict[str, float]

SENSORS, QUICK_SENSORS = 16, 2
SEED = 4000  # added to seeds, which keeps test sensors apart from those of training sets
SENSOR_FRAMES = (
    SceneGroup("idle", count=3),
    SceneGroup("bend", count=3, angle_deg=(-20.0, -5.0)),
    SceneGroup("bend", count=9, angle_deg=(5.0, 50.0)),
    SceneGroup("touch", count=6, force=(4.0, 12.0)),
    SceneGroup("touch", count=6, force=(4.0, 12.0), angle_deg=(-20.0, 50.0), per_bend=3),
)
"""Frames of each sensor. The state of bends below 5 deg, which are nearly flat, is not asked."""
KNOWN_FRAMES = (
    SceneGroup("idle", count=1),
    *(SceneGroup("bend", count=1, angle_deg=(angle, angle)) for angle in KNOWN_DEG),
    SceneGroup("bend", count=15, angle_deg=(-20.0, 50.0)),
    SceneGroup("touch", count=80, force=(4.0, 12.0)),
)
"""Labelled frames of each sensor, to adapt by: angles, and presses on the flat sensor."""
OVER_PLATES: dict[str, Any] = {"from_middle": (0.026, 0.075), "force": (4.0, 10.0)}
"""Presses of sensors on plates, which carry them; their gap gives way."""

# The spread of specimens that share the bends of their mounts.
_SHARED_BENDS = dict.fromkeys(
    ("thickness", "gel_modulus", "encapsulation_modulus", "hinge_span", "hinge_offset"), 0.0
)
WORLDS: dict[str, tuple[dict[str, float], dict[str, Any]]] = {
    "as trained": ({}, {}),
    # Clamps with other spans, axes and held faces, without a spread about each.
    "other clamps": (
        _SHARED_BENDS,
        {"mounts": Mounts(8, (0.028, 0.057), (0.005, 0.013), faces=("both", "bottom"))},
    ),
    # Encapsulations 0.7 to 2 times as stiff, in clamps as in training: softer ones are out of
    # reach of 12 N.
    "other stiffness": (_SHARED_BENDS, {"mounts": Mounts(4, stiffness=(0.7, 2.0))}),
    # Electrodes placed within 1 mm, contacts that differ by a factor of 2 between them.
    "rough electrodes": (
        {"conductivity": 0.5, "contact_impedance": 0.8, "electrode_place": 0.001},
        {},
    ),
    # Loads to ground of the board's source, its sink and its idle electrodes.
    "other board": (
        {},
        {
            "instrument": Instrument(
                snr_db=72.0,
                meter=FourTerminalMeter(source=2e-5, sink=2e-4, idle=2e-5, common_mode=0.01),
            )
        },
    ),
}
"""Of each world that counts on the leaderboard, what its recipe changes in the spread of the
sensors, and besides."""
ALL_WORLDS = WORLDS | {
    "on plates": ({}, {"sensor": replace(SensorDesign.reference(), support=Plates())}),
}
_COLUMNS: Columns = {
    "pipeline": ("pipeline", "", 1),
    "world": ("world", "", 1),
    "labelled": ("labelled", "", 1),
    "states [%]": ("states right", ".3g", 100.0),
    "angle [deg]": ("angle, rms [deg]", ".3g", 1.0),
    "/ SE": ("angle, error over standard error", ".3g", 1.0),
    "numbers [%]": ("numbers of touches right", ".3g", 100.0),
    "found [%]": ("touches found", ".3g", 100.0),
    "place [mm]": ("place, mean [mm]", ".3g", 1.0),
    "place / SE": ("place, error over standard error", ".3g", 1.0),
    "refused [%]": ("sensors refused", ".3g", 100.0),
}


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """Frames of the sensors of one world.

    Attributes:
        name: name of the world.
        frames: flat, bent and touched, to be tested.
        known: labelled frames of the same sensors in the same sessions, to adapt by.
    """

    name: str
    frames: Dataset
    known: Dataset


def make(folder: Path, seed: int, quick: bool, workers: int, progress: Progress) -> list[World]:
    """Generate the frames that `folder` does not have yet, and read all of them.

    Raises ConfigurationError where `folder` holds frames of other recipes.
    """
    worlds = []
    for name in ALL_WORLDS:
        sets = []
        for recipe in recipes(name, seed, quick):
            place = folder / recipe.name.replace(" ", "-").replace(",", "")
            part = f"frames: {recipe.name}"
            sets.append(generate_missing(recipe, place, workers, progress, part))
        worlds.append(World(name, sets[0], _exclude_same_draws(*sets)))
    return worlds


def _exclude_same_draws(frames: Dataset, known: Dataset) -> Dataset:
    """Known frames less presses whose place and noise were drawn as those of a tested frame.

    Draws follow from a frame's number; only the first sensor has the same numbers in both sets.
    """
    judged = dict(zip(frames.number.tolist(), frames.specimen.tolist(), strict=True))
    pairs = zip(known.number.tolist(), known.specimen.tolist(), strict=True)
    same = np.array([judged.get(number) == specimen for number, specimen in pairs])
    return known.select(np.flatnonzero(~same | (known.state != State.TOUCH)))


def recipes(world: str, seed: int, quick: bool) -> tuple[Recipe, Recipe]:
    """Recipes of the frames to be tested and of the known frames of a world."""
    training, count = Recipe.from_shipped("training"), QUICK_SENSORS if quick else SENSORS
    spread, changes = ALL_WORLDS[world]
    sensor = changes.get("sensor", training.sensor)

    def count_every_sensor(groups: Sequence[SceneGroup]) -> tuple[SceneGroup, ...]:
        over_plates = OVER_PLATES if isinstance(sensor.support, Plates) else {}
        return tuple(
            replace(
                group, count=group.count * count, **(over_plates if group.state == "touch" else {})
            )
            for group in groups
        )

    frames = replace(
        training,
        name=world,
        description="",
        seed=SEED + seed,
        specimens=replace(training.specimens, count=count, **spread),
        reference_frames=8,
        touch_frames=1,
        scenes=count_every_sensor(SENSOR_FRAMES),
    )
    frames = replace(frames, **changes)
    return frames, replace(frames, name=f"{world}, known", scenes=count_every_sensor(KNOWN_FRAMES))


@dataclass(frozen=True, slots=True)
class LabelledCounts:
    """Numbers of labelled frames that a sensor is adapted by, next to one of the flat sensor."""

    angles: int
    presses: int

    def __str__(self) -> str:
        """Name in rows of the results."""
        return f"{self.angles} angles" + f", {self.presses} presses" * bool(self.presses)

    def rows(self, mine: Dataset) -> list[int]:
        """Rows of the flat frame, of bent ones and of presses among the known frames of a sensor.

        The fixed angles come first, the largest before the others; of fewer presses all are taken.

        Raises DataError where there are too few angles.
        """
        flat = np.flatnonzero(mine.state == State.IDLE)
        bent = np.flatnonzero(mine.state == State.BEND)
        if len(bent) < self.angles or not len(flat):
            raise DataError(
                f"expected {self.angles} known angles and a flat frame, got {len(bent)} angles"
            )
        angles = mine.bend_angle_deg[bent]
        order = bent[np.lexsort((-np.abs(angles), ~np.isin(angles, KNOWN_DEG)))]
        presses = np.flatnonzero(mine.state == State.TOUCH)[: self.presses]
        return [int(flat[0]), *order[: self.angles].tolist(), *presses.tolist()]


def judge(data: Dataset, predictions: Predictions) -> Figures:
    """Figures of predictions; angles are those of untouched frames."""
    matches, free = Matches.from_dataset(data, predictions), data.state != State.TOUCH
    angle = (predictions.bend_angle_deg - data.bend_angle_deg)[free]
    numbers = np.array([len(touches) for touches in predictions.touches])
    figures = {
        "states right": float((predictions.state == data.state).mean()),
        "angle, rms [deg]": root_mean_square(angle),
        "angle, error over standard error": root_mean_square(
            angle / predictions.bend_deviation_deg[free]
        ),
        "numbers of touches right": float((numbers == data.touch_count).mean()),
        "touches found": float(len(matches.error) / data.touch_count.sum()),
    }
    if len(matches.error):
        ratio = root_mean_square(matches.error / matches.deviation)
        figures["place, mean [mm]"] = 1e3 * float(matches.error.mean())
        figures["place, error over standard error"] = ratio
    return figures


def scores(pipeline: Pipeline, world: World, counts: LabelledCounts) -> Figures:
    """Figures of a pipeline in a world, adapted to each sensor by some of its known frames.

    A sensor that is refused is tested with the pipeline as trained, and counted.
    """
    parts, predictions, refused = [], [], 0
    for number in np.unique(world.frames.specimen):
        own = replace(pipeline)
        if counts.angles or counts.presses:
            mine = world.known.select(world.known.specimen == number)
            try:
                own.adapt(mine.select(counts.rows(mine)))
            except EitskinError:
                refused += 1
        parts.append(np.flatnonzero(world.frames.specimen == number))
        predictions.append(own.perceive(world.frames.select(parts[-1])))
    data = world.frames.select(np.concatenate(parts))
    figures = judge(data, Predictions.concatenate(predictions))
    return figures | {"sensors refused": refused / len(parts)}


LABELLED_COUNTS = tuple(
    LabelledCounts(*each) for each in ((0, 0), (1, 0), (5, 0), (5, 15), (20, 80))
)
"""Labelled frames that a sensor is adapted by."""


def run(
    pipelines: Mapping[str, Path],
    folder: Path,
    seed: int,
    quick: bool,
    workers: int,
    progress: Progress,
) -> Report:
    """Measure pipelines, saved at the paths given, on sensors of every world.

    Raises ConfigurationError where `folder` holds frames of other recipes.
    """
    began = time.perf_counter()
    worlds = make(folder, seed, quick, workers, progress)
    rows: list[dict[str, Any]] = []
    for number, (name, path) in enumerate(pipelines.items()):
        pipeline = Pipeline.load(path)
        for place, world in enumerate(worlds):
            progress("scores", number * len(worlds) + place, len(worlds) * len(pipelines))
            for labelled in LABELLED_COUNTS:
                names = {"pipeline": name, "world": world.name, "labelled": str(labelled)}
                rows.append(names | scores(pipeline, world, labelled))
    progress("scores", len(worlds) * len(pipelines), len(worlds) * len(pipelines))
    figures: list[tuple[str, float]] = []
    for row in rows:
        start = f"{row['pipeline']} / {row['world']}, {row['labelled']}"
        figures += [(f"{start} / {name}", row[name]) for name in list(row)[3:]]
    return Report(
        results=make_results("transfer", figures, began=began, seed=seed, quick=quick),
        rows=[{name: row.get(name) for name, *_ in _COLUMNS.values()} for row in rows],
        tables=[ReportTable.from_rows(rows, _COLUMNS, 3)],
    )
