"""Run of `bench life`: a pipeline in streams of what skins meet every day, tested by event.

Two shares of frames count. A frame is confidently wrong where state, number of touches, a place or
the angle is off, by more than three claimed standard errors and 5 mm or 2 deg, and no problem is
reported; it is flagged though right where a problem is reported that nothing called for.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.life_world import (
    EVENTS,
    KNOWN_DEG,
    NOISE,
    OPENING,
    PAIR_FORCE,
    PAIR_FRAMES,
    PAIRS,
    Event,
    Stream,
    lives,
)
from eitskin.benchmarks.results import Columns, Progress, Report, ReportTable, make_results
from eitskin.datasets.store.schema import State
from eitskin.geometry.deformation.fixtures import Bend
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.scene.scene import Scene, Touch
from eitskin.simulator.simulator import Simulator
from eitskin.training.evaluation.cramer_rao import scene_derivatives
from eitskin.training.evaluation.scores import match, root_mean_square
from eitskin.training.method.predictions import Estimate
from eitskin.training.pipeline.pipeline import Pipeline

Array = NDArray[np.float64]

SENSORS, QUICK_SENSORS = 15, 5
SENSORS_AN_HOUR = 14  # whose streams last an hour together
DEVIATIONS, LEAST_PLACE, LEAST_ANGLE = 3.0, 0.005, 2.0  # [m], [deg]: further off is wrong
KNOWABLE = 3.0  # least signal of touches, in standard deviations of the noise of a frame
FLAT_DEG = 4.0  # bends below this may be called idle
ALL_EVENTS = "all events"
_COLUMNS: Columns = {
    "event": ("event", "", 1),
    "frames": ("frames", "d", 1),
    "wrong [%]": ("confidently wrong", ".2f", 100.0),
    "below noise [%]": ("wrong, below the noise", ".2f", 100.0),
    "flagged [%]": ("flagged though right", ".2f", 100.0),
    "told [%]": ("with a problem", ".3g", 100.0),
    "place [mm]": ("place, rms [mm]", ".3g", 1.0),
    "/ SE": ("place, error over standard error", ".3g", 1.0),
    "angle [deg]": ("angle, rms [deg]", ".3g", 1.0),
    "/ SE ": ("angle, error over standard error", ".3g", 1.0),
    "force [N]": ("force, bias [N]", "+.2f", 1.0),
    "delay": ("delay [frames]", ".2g", 1.0),
}
RESOLVED = 0.010  # m, within which both touches of a pair are to be found
_PAIR_COLUMNS: Columns = {
    "distance [mm]": ("distance [mm]", ".0f", 1.0),
    "weaker force": ("share", ".2f", 1.0),
    "bend [deg]": ("bend [deg]", ".0f", 1.0),
    "resolved [%]": ("resolved", ".0f", 100.0),
    "bound [mm]": ("bound [mm]", ".2g", 1.0),
}


@dataclass(slots=True)
class Judgements:
    """Tested frames of one event: shares, errors, and errors over standard errors."""

    wrong: list[bool] = field(default_factory=list)
    below: list[bool] = field(default_factory=list)
    flagged: list[bool] = field(default_factory=list)
    told: list[bool] = field(default_factory=list)
    place: list[float] = field(default_factory=list)
    place_ratio: list[float] = field(default_factory=list)
    angle: list[float] = field(default_factory=list)
    angle_ratio: list[float] = field(default_factory=list)
    force: list[float] = field(default_factory=list)
    delay: list[float] = field(default_factory=list)

    def add(
        self,
        said: Estimate,
        touches: Array,
        angle_deg: float,
        event: Event,
        signal: float = np.inf,
    ) -> bool:
        """Test an estimate by the touches (k, 3) and the angle [deg]; returns whether right.

        The signal is that of the touches, `Stream.signal`.
        """
        true = touches[np.isfinite(touches[:, 0])]
        right = self._places(said, true, event) and self._angle(said, angle_deg, bool(len(true)))
        if not len(true) and abs(angle_deg) < FLAT_DEG:
            right &= said.state is State.IDLE or (said.state is State.BEND and angle_deg != 0.0)
        else:
            right &= said.state is (State.TOUCH if len(true) else State.BEND)
        has_problem = bool(said.problems)
        self.wrong.append(not right and not has_problem)
        self.below.append(self.wrong[-1] and signal < KNOWABLE)
        self.flagged.append(right and has_problem and event.healthy)
        self.told.append(has_problem)
        return right

    def _places(self, estimate: Estimate, true: Array, event: Event) -> bool:
        """Whether the places are right and as many, or fewer whose standard errors cover all.

        Keeps the errors.
        """
        estimated = np.array([[t.x, t.y, t.force, t.deviation] for t in estimate.touches or ()])
        estimated = estimated.reshape(-1, 4)
        if not event.known:
            if len(estimated) != 1 or not len(true):
                return False
            true = true.mean(axis=0, keepdims=True)
        rows, columns = match(true[:, :2], estimated[:, :2])
        errors = np.linalg.norm(true[rows, :2] - estimated[columns, :2], axis=1)
        deviations = estimated[columns, 3]
        self.place += errors.tolist()
        self.place_ratio += (errors / deviations).tolist()
        self.force += (estimated[columns, 2] - true[rows, 2]).tolist() if event.known else []
        if 0 < len(estimated) < len(true):  # one that says that it may be anywhere about both
            apart = np.linalg.norm(true[:, None, :2] - estimated[:, :2], axis=2)
            return bool((apart <= DEVIATIONS * estimated[:, 3]).any(axis=1).all())
        near = errors <= np.maximum(DEVIATIONS * deviations, LEAST_PLACE)
        return bool(near.all()) and len(near) == len(estimated) == len(true)

    def _angle(self, said: Estimate, angle_deg: float, touched: bool) -> bool:
        """Whether the angle is right; keeps its error, of bent sensors."""
        if said.bend_angle_deg is None:
            return False
        error, deviation = said.bend_angle_deg - angle_deg, said.bend_deviation_deg or np.nan
        if abs(angle_deg) >= FLAT_DEG and not touched:
            self.angle.append(error)
            self.angle_ratio.append(error / deviation)
        return abs(error) <= max(DEVIATIONS * deviation, LEAST_ANGLE)

    def row(self, name: str) -> dict[str, Any]:
        """Figures by their names; None where there are none."""

        def rms(values: Sequence[float], factor: float = 1.0) -> float | None:
            finite_values = [value for value in values if np.isfinite(value)]
            return factor * root_mean_square(np.array(finite_values)) if finite_values else None

        return {
            "event": name,
            "frames": len(self.wrong),
            "confidently wrong": float(np.mean(self.wrong)),
            "wrong, below the noise": float(np.mean(self.below)),
            "flagged though right": float(np.mean(self.flagged)),
            "with a problem": float(np.mean(self.told)),
            "place, rms [mm]": rms(self.place, 1e3),
            "place, error over standard error": rms(self.place_ratio),
            "angle, rms [deg]": rms(self.angle),
            "angle, error over standard error": rms(self.angle_ratio),
            "force, bias [N]": float(np.mean(self.force)) if self.force else None,
            "delay [frames]": float(np.mean(self.delay)) if self.delay else None,
        }


def judge(
    pipeline: Pipeline, stream: Stream, frames: Sequence[Any], event: Event, signal: Array
) -> Judgements:
    """Test the estimates of a session's frames after its opening, by the signal (n,) of each too.

    The delay is the number of frames from each change of the touches to the first right estimate.
    """
    pipeline.reset()
    found, waiting = Judgements(), None
    for n, frame in enumerate(frames):
        if n < OPENING:
            pipeline.process(frame)
            continue
        true = stream.touches[n], float(stream.angle_deg[n])
        right = found.add(pipeline.process(frame), *true, event, float(signal[n]))
        before, now = np.isfinite(stream.touches[n - 1 : n + 1, :, 0]).sum(axis=1).tolist()
        if before != now:
            waiting = n
        if waiting is not None and right:
            found.delay.append(float(n - waiting))
            waiting = None
    return found


def resolves(pipeline: Pipeline, stream: Stream, frames: Sequence[Any]) -> bool:
    """Whether two touches are found within `RESOLVED` in the last frame of a session of a pair."""
    pipeline.reset()
    touches = [pipeline.process(frame).touches for frame in frames][-1] or ()
    places, true = np.array([[t.x, t.y] for t in touches]).reshape(-1, 2), stream.touches[-1]
    rows, columns = match(true[:, :2], places)
    errors = np.linalg.norm(true[rows, :2] - places[columns], axis=1)
    return len(places) == len(errors) == 2 and bool((errors <= RESOLVED).all())


def pair_bound(board: Instrument, distance: float, ratio: float, angle_deg: float) -> float:
    """Cramer-Rao bound [mm] of the place of the weaker touch of a pair of `PAIRS`.

    The pair is along x in the middle, and seen in as many frames as its reference.
    """
    x, y = 0.075 - 0.5 * distance, 0.030
    pair = Touch(x, y, PAIR_FORCE), Touch(x + distance, y, PAIR_FORCE * ratio)
    simulator = Simulator(SensorDesign.reference(), "coarse")
    derivatives = scene_derivatives(simulator, Scene(Bend(angle_deg), pair))
    noise = derivatives.noise(board, float(np.abs(derivatives.resistance).max()))
    return 1e3 * float(derivatives.bound(noise / np.sqrt(PAIR_FRAMES)).place[1])


def run(
    path: Path,
    folder: Path,
    seed: int,
    hours: float | None,
    quick: bool,
    progress: Progress,
) -> Report:
    """Measure a pipeline in the streams of some sensors.

    Args:
        path: path of the pipeline.
        folder: folder of the streams, which are kept.
        seed: seed of sensors, events and noise.
        hours: hours of streams; of `SENSORS` sensors when omitted.
        quick: fewer sensors.
        progress: called after sensors that are done.
    """
    began = time.perf_counter()
    count = QUICK_SENSORS if quick else SENSORS
    if hours is not None:
        count = max(1, round(SENSORS_AN_HOUR * hours))
    all_judged: dict[str, Judgements] = {name: Judgements() for name in (*EVENTS, ALL_EVENTS)}
    trained = Pipeline.load(path)
    resolved: dict[tuple[float, ...], list[bool]] = {cell: [] for cell in PAIRS}
    for number, life in enumerate(lives(folder, seed, count, progress)):
        low, high = np.log(NOISE)
        parts = life.board, life.protocol, trained.layout.frequency
        for place, (name, event) in enumerate(EVENTS.items()):
            drawn = seed, number, place
            noise = float(np.exp(np.random.default_rng(drawn).uniform(low, high)))
            pipeline, stream = replace(trained), life.streams[name]
            if event.calibrated:
                known_frames = life.known.frames(*parts, 1.0, (*drawn, 1))[OPENING:]
                pipeline.calibrate(known_frames, KNOWN_DEG)
            frames = stream.frames(*parts, noise, (*drawn, 0))
            signal = stream.signal(*parts[:2], noise)
            judgements = judge(pipeline, stream, frames, event, signal)
            for each in (all_judged[name], all_judged[ALL_EVENTS]):
                for part in Judgements.__slots__:
                    getattr(each, part).extend(getattr(judgements, part))
        for place, (cell, stream) in enumerate(life.pairs.items()):
            frames = stream.frames(*parts, 1.0, (seed, number, place, 2))
            resolved[cell].append(resolves(replace(trained), stream, frames))
    pairs: list[dict[str, Any]] = [
        {"distance [mm]": 1e3 * cell[0], "share": cell[1], "bend [deg]": cell[2]}
        | {"resolved": np.mean(found).item(), "bound [mm]": pair_bound(life.board, *cell)}
        for cell, found in resolved.items()
    ]
    rows = [judgements.row(name) for name, judgements in all_judged.items()]
    figures = [
        (f"{row['event']} / {name}", value)
        for row in rows
        for name, value in row.items()
        if name != "event" and value is not None
    ]
    for (distance, share, angle), pair in zip(resolved, pairs, strict=True):
        label = f"{1e3 * distance:.0f} mm, {share:.2f}, {angle:.0f} deg"
        figures += [(f"{label} / {name}", pair[name]) for name in ("resolved", "bound [mm]")]
    options = f"--seed {seed}" + (f" --hours {hours:g}" if hours is not None else "")
    results = make_results("life", figures, began=began, seed=seed, quick=quick, options=options)
    shown = ((rows, _COLUMNS), (pairs, _PAIR_COLUMNS))
    tables = [ReportTable.from_rows(*each) for each in shown]
    return Report(results=results, rows=rows, tables=tables)
