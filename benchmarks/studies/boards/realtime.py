"""Real-time episode of the paper on the virtual board.

Run by `python -m eitskin.benchmarks.studies.boards.realtime`.

The recipe `paper_demo` is played on a sensor that no pipeline was trained with, at the board's real
pace, through a pseudo-terminal into the pipeline that ships: first as it comes, then adapted to
the sensor by five angles that are taken from the same board. Writes a table, a CSV and a plot.
"""

import argparse
import dataclasses
import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from eitskin.benchmarks.results import write_table
from eitskin.datasets.recipe.frame_sampling import sample, specimen
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.store.state import State
from eitskin.extras import require
from eitskin.frame import Frame
from eitskin.geometry.deformation.fixtures import Bend
from eitskin.hardware.live import Reading, run_live
from eitskin.hardware.virtual.virtual_board import VirtualBoard, open_virtual
from eitskin.provenance import Provenance
from eitskin.simulator.scene.scene import Scene

if TYPE_CHECKING:
    from eitskin.training.pipeline.pipeline import Pipeline

PERIOD = 0.303  # s, the paper's
PAPER_MS = {"acquisition": 303.0, "state": 91.6, "reconstruction": 86.7, "all of a frame": 606.6}
MOMENTS = {"a1": -10.0, "a2": 20.0, "a3": 40.0, "a4": 0.0}
"""The paper's four moments: the angle at which touches are set on, in their order."""
ANGLES_DEG = (0.0, -20.0, 15.0, 30.0, 42.5, 50.0)
PER_ANGLE = 8


@dataclass(frozen=True, slots=True)
class Moment:
    """Moment of the paper's episode, while its touches are held.

    Attributes:
        name: the paper's.
        angle_deg: true bend.
        touches: how many there are.
        frames: that show them, and of those, the share in which the state is touch.
        right: that share.
        angle_error_deg: rms over the frames.
        errors_mm: distance of each touch that was found, all frames.
        found: share of the touches found.
        false: touches found where none is, a frame.
    """

    name: str
    angle_deg: float
    touches: int
    frames: int
    right: float
    angle_error_deg: float
    errors_mm: tuple[float, ...]
    found: float
    false: float


@dataclass(frozen=True, slots=True)
class EpisodeRun:
    """Readings and scenes of one run of the episode.

    Attributes:
        readings: of all frames.
        scenes: that they were measured of.
        moments: the paper's four.
    """

    readings: tuple[Reading, ...]
    scenes: tuple[Scene, ...]
    moments: tuple[Moment, ...]

    @property
    def angles_deg(self) -> tuple[np.ndarray, np.ndarray]:
        """True and estimated angle of each frame."""
        said = [r.estimate.bend_angle_deg if r.estimate else np.nan for r in self.readings]
        return np.array([scene.bend.angle_deg for scene in self.scenes]), np.array(said)

    @property
    def times(self) -> np.ndarray:
        """Times of the frames since the first [s]."""
        times = np.array([reading.frame.time for reading in self.readings])
        shifted: np.ndarray = times - times[0]
        return shifted

    @property
    def right(self) -> float:
        """Share of the frames whose state is right."""
        states = [r.estimate.state if r.estimate else None for r in self.readings]
        true = [_state(scene) for scene in self.scenes]
        return float(np.mean([a == b for a, b in zip(states, true, strict=True)]))

    def angle_rmse(self, touched: bool) -> float:
        """Root mean square error [deg] of the angle in touched or untouched frames."""
        true, said = self.angles_deg
        chosen = np.array([bool(_acting(scene)) for scene in self.scenes]) == touched
        return float(np.sqrt(np.nanmean((said - true)[chosen] ** 2)))


def run(seed: int, speed: str = "real") -> tuple[EpisodeRun, EpisodeRun]:
    """Runs of the episode with the shipped pipeline, and with it calibrated to the sensor."""
    from eitskin.training.pipeline.pipeline import Pipeline

    recipe = unseen(seed)
    made = specimen(recipe, 0)
    # Presses of thirteen fading dents take 0.6 s; `standard` takes so long that a stream is stale.
    simulator = made.simulator(None, "fast")
    pressed = next(
        scene for n in range(recipe.frames) if (scene := sample(recipe, n).scene).touches
    )
    simulator.measure(pressed)  # solves the table of presses, which no board would wait for
    pipeline = Pipeline.load("reference.eitmodel")
    with open_virtual(
        simulator=simulator,
        instrument="ad5940",
        speed=speed,
        seed=seed,
        period=PERIOD,
    ) as board:
        plain = play(board, pipeline, recipe)
        pipeline.calibrate(*known_angles(board))
        return plain, play(board, pipeline, recipe)


def unseen(seed: int) -> Recipe:
    """Recipe of the episode on a sensor that differs as in the recipe `training`."""
    training = Recipe.shipped("training")
    one = dataclasses.replace(training.specimens, count=1)
    return dataclasses.replace(
        Recipe.shipped("paper_demo"), specimens=one, sensor=training.sensor, seed=1000 + seed
    )


def play(board: VirtualBoard, pipeline: "Pipeline", recipe: Recipe) -> EpisodeRun:
    """Play the episode from its first frame on."""
    stage = board.stage
    count = recipe.frames
    pipeline.reset()
    stage.play(lambda number: sample(recipe, min(number, count - 1)).scene)
    readings = list(itertools.islice(run_live(board, pipeline, newest=False), count))
    scenes = [stage.truth(reading.frame.number) or Scene() for reading in readings]
    return EpisodeRun(tuple(readings), tuple(scenes), tuple(_moments(readings, scenes)))


def known_angles(board: VirtualBoard) -> tuple[list[Frame], list[float]]:
    """Frames of the untouched sensor at known angles, for a calibration."""
    stage = board.stage
    stage.play(lambda n: Scene(Bend(ANGLES_DEG[min(n // PER_ANGLE, len(ANGLES_DEG) - 1)])))
    frames = list(itertools.islice(board.frames(), PER_ANGLE * len(ANGLES_DEG)))
    known = [stage.truth(frame.number) or Scene() for frame in frames]
    return frames, [scene.bend.angle_deg for scene in known]


def _moments(readings: Sequence[Reading], scenes: Sequence[Scene]) -> list[Moment]:
    """Moments of the paper among the frames: runs of touched frames, in order."""
    runs = [
        [index for index, _ in group]
        for touched, group in itertools.groupby(
            enumerate(scenes), key=lambda item: bool(_acting(item[1]))
        )
        if touched
    ]
    return [
        _moment(name, [readings[i] for i in run], [scenes[i] for i in run])
        for name, run in zip(MOMENTS, runs, strict=True)
    ]


def _moment(name: str, readings: Sequence[Reading], scenes: Sequence[Scene]) -> Moment:
    from eitskin.training.evaluation import matching

    true = np.array([(touch.x, touch.y) for touch in _acting(scenes[0])])
    estimates = [reading.estimate for reading in readings if reading.estimate is not None]
    found = [np.array(e.touches)[:, :2] if e.touches else np.empty((0, 2)) for e in estimates]
    score = matching.localisation([(true, places) for places in found])
    angles = [e.bend_angle_deg for e in estimates if e.bend_angle_deg is not None]
    wrong = [angle - scenes[0].bend.angle_deg for angle in angles]
    expected = len(true) * len(readings)
    return Moment(
        name=name,
        angle_deg=scenes[0].bend.angle_deg,
        touches=len(true),
        frames=len(readings),
        right=float(np.mean([e.state == State.TOUCH for e in estimates])),
        angle_error_deg=float(np.sqrt(np.mean(np.square(wrong)))),
        errors_mm=tuple(1e3 * error for error in score.errors),
        found=len(score.errors) / expected,
        false=score.false / len(readings),
    )


def _acting(scene: Scene) -> list:  # type: ignore[type-arg]
    return [touch for touch in scene.touches if not touch.released]


def _state(scene: Scene) -> State:
    if _acting(scene):
        return State.TOUCH
    return State.BEND if scene.bend.angle_deg else State.IDLE


def report(runs: dict[str, EpisodeRun], seed: int) -> list[str]:
    """Report tables, as Markdown."""
    lines = [f"Measured on {Provenance.now(seed)}", ""]
    columns = (
        "moment", "bend", "touches", "frames", "state right", "angle error, rms",
        "touches found", "false, a frame", "touch error, mean (largest)",
    )  # fmt: skip
    for name, run in runs.items():
        lines += [f"## {name}", "", "| " + " | ".join(columns) + " |", "|---" * len(columns) + "|"]
        for m in run.moments:
            error = f"{np.mean(m.errors_mm):.1f} ({max(m.errors_mm):.1f}) mm"
            lines.append(
                f"| {m.name} | {m.angle_deg:+.0f} deg | {m.touches} | {m.frames} | "
                f"{100 * m.right:.0f} % | {m.angle_error_deg:.2f} deg | {100 * m.found:.0f} % | "
                f"{m.false:.2f} | {error} |"
            )
        lines += ["", f"- all frames, {name}: {_summary(run)}", ""]
    return [*lines, *_times(runs)]


def _summary(run: EpisodeRun) -> str:
    true, said = run.angles_deg
    r2 = 1.0 - np.nansum((said - true) ** 2) / np.sum((true - true.mean()) ** 2)
    return (
        f"state right in {100 * run.right:.1f} %; angle rms {run.angle_rmse(False):.2f} deg "
        f"untouched, {run.angle_rmse(True):.2f} deg touched; R2 {r2:.4f}"
    )


def _times(runs: dict[str, EpisodeRun]) -> list[str]:
    latency = 1e3 * np.array([r.latency for run in runs.values() for r in run.readings])
    half, slowest = np.percentile(latency, (50, 99))
    paper, period = PAPER_MS["all of a frame"], 1e3 * PERIOD
    return [
        "| time of a frame, ms | paper | here |",
        "|---|---|---|",
        f"| acquisition | {PAPER_MS['acquisition']:.0f} | {period:.0f}, set |",
        f"| all processing, median (p99) | {paper - PAPER_MS['acquisition']:.1f} | "
        f"{half:.1f} ({slowest:.1f}) |",
        f"| all of a frame | {paper:.1f} | {period + half:.1f} |",
    ]


def _angle(reading: Reading) -> float | str:
    """Estimated angle in few digits [deg]; empty where there is none."""
    angle = None if reading.estimate is None else reading.estimate.bend_angle_deg
    return "" if angle is None else round(angle, 3)


def write(runs: dict[str, EpisodeRun], folder: Path, seed: int) -> None:
    """Write the frames as CSV and the plot."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = [
        {
            "run": name,
            "time_s": round(moment, 3),
            "true_angle_deg": round(scene.bend.angle_deg, 3),
            "angle_deg": _angle(reading),
            "true_state": _state(scene).name.lower(),
            "state": str(getattr(reading.estimate and reading.estimate.state, "name", "")).lower(),
            "latency_ms": round(1e3 * reading.latency, 2),
        }
        for name, run in runs.items()
        for reading, scene, moment in zip(run.readings, run.scenes, run.times, strict=True)
    ]
    write_table(folder / "realtime.csv", rows, str(Provenance.now(seed)))
    plot(runs, folder / "realtime.png")


def plot(runs: dict[str, EpisodeRun], path: Path) -> None:
    """Predicted beside true angle over time, and the touch maps of the four moments."""
    figure = require("matplotlib.figure", "bench").Figure(figsize=(10, 6.4), layout="constrained")
    top, bottom = figure.subfigures(2, 1, height_ratios=(1.5, 1.0))
    axes = top.subplots()
    for (name, run), colour in zip(runs.items(), ("#b8860b", "#1f5fa8"), strict=True):
        times = run.times
        axes.plot(times, run.angles_deg[1], ".", ms=4, color=colour, label=name)
    axes.plot(times, run.angles_deg[0], color="black", lw=1.0, label="true")
    for moment, frames in _held(run).items():
        axes.axvspan(times[frames[0]], times[frames[-1]], color="#dde6ee", lw=0)
        middle = times[frames].mean()
        axes.text(middle, 0.03, moment, ha="center", transform=axes.get_xaxis_transform())
    axes.set(xlabel="time [s]", ylabel="bend angle [deg]", xlim=(0, times[-1]))
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="upper left", ncols=3)
    for panel, (moment, frames) in zip(bottom.subplots(1, 4), _held(run).items(), strict=True):
        _draw_map(panel, run, frames[-1], moment)
    figure.savefig(path, dpi=120, facecolor="white")


def _held(run: EpisodeRun) -> dict[str, list[int]]:
    touched = itertools.groupby(range(len(run.scenes)), lambda i: bool(_acting(run.scenes[i])))
    return dict(zip(MOMENTS, (list(group) for held, group in touched if held), strict=True))


def _draw_map(axes, run: EpisodeRun, frame: int, moment: str) -> None:  # type: ignore[no-untyped-def]  # noqa: ANN001
    estimate, scene = run.readings[frame].estimate, run.scenes[frame]
    if estimate is not None:
        axes.imshow(estimate.touch_map, origin="lower", extent=(0, 150, 0, 60), cmap="viridis")
    for touch in _acting(scene):
        axes.plot(1e3 * touch.x, 1e3 * touch.y, "o", mfc="none", mec="white", ms=9)
    axes.set(xticks=(0, 150), yticks=(0, 60))
    axes.set_title(f"{moment}: {scene.bend.angle_deg:+.0f} deg, {len(_acting(scene))} touches")


def main() -> None:
    """Run, print and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("build/bench"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--speed", choices=("real", "max"), default="real")
    given = parser.parse_args()
    began = time.perf_counter()
    plain, calibrated = run(given.seed, given.speed)
    runs = {"as it ships": plain, "calibrated by five angles": calibrated}
    print("\n".join(report(runs, given.seed)))
    write(runs, given.out, given.seed)
    print(f"\n{time.perf_counter() - began:.0f} s; written to {given.out}")


if __name__ == "__main__":
    main()
