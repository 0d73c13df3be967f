"""The paper's real-time episode on a virtual board: touches at four bends."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table

from eitskin.geometry.deformation.fixtures import Bend
from eitskin.simulator.scene.scene import Scene, Touch

if TYPE_CHECKING:
    from eitskin.hardware.live import FramePipeline, Reading

FRAMES = 12  # of each step

_SPREAD = (Touch(0.025, 0.018), Touch(0.050, 0.042), Touch(0.100, 0.042), Touch(0.125, 0.018))
_OTHERS = (Touch(0.025, 0.042), Touch(0.060, 0.018), Touch(0.090, 0.042), Touch(0.125, 0.018))
STEPS = (
    Scene(),
    Scene(Bend(-10.0)),
    Scene(Bend(-10.0), (Touch(0.040, 0.020), Touch(0.110, 0.040))),
    Scene(Bend(20.0)),
    Scene(Bend(20.0), (Touch(0.030, 0.040), Touch(0.075, 0.018), Touch(0.120, 0.040))),
    Scene(Bend(40.0)),
    Scene(Bend(40.0), _SPREAD),
    Scene(),
    Scene(touches=_OTHERS),
)
COLUMNS = ("true", "state", "angle, deg", "touches: true", "found", "error, mm", "ms/frame")


def run_episode(pipeline: "FramePipeline", seed: int, frames: int = FRAMES) -> list[dict[str, Any]]:
    """Play the episode through a virtual board and `pipeline`; one row of results per step.

    Every frame crosses the pseudo-terminal as packets, as from a real board. A row holds the state
    estimated in most frames of its step, the median angle, the touches of the last frame, and
    state, angle, touches and time of each frame.
    """
    from eitskin.hardware.live import run_live
    from eitskin.hardware.opening import open_board
    from eitskin.hardware.virtual.stage import Script, Step

    script = Script(tuple(Step(scene, frames) for scene in STEPS), repeat=False)
    readings: list[Reading] = []
    with open_board("virtual:", scene=script, speed="max", seed=seed) as board:
        for reading in run_live(board, pipeline, newest=False):
            readings.append(reading)
            if len(readings) == frames * len(STEPS):
                break
    return [_row(scene, readings[i * frames : (i + 1) * frames]) for i, scene in enumerate(STEPS)]


def episode_cells(row: dict[str, Any]) -> tuple[str, ...]:
    """Cells of a step's row: truth and estimate, one text for each of `COLUMNS`."""
    return (
        row["true_state"],
        f"{row['state']} ({row['right_frames']}/{len(row['states'])})",
        f"{row['angle_deg']:+.1f} (true {row['true_angle_deg']:+.0f})",
        _places(row["true_touches_mm"]),
        _places(row["touches_mm"]),
        ", ".join(f"{error:.1f}" for error in row["errors_mm"]) or "-",
        f"{row['latency_ms']:.1f}",
    )


def episode_table(rows: Sequence[dict[str, Any]]) -> Table:
    """Table of all steps."""
    table = Table(*COLUMNS)
    for row in rows:
        table.add_row(*episode_cells(row))
    return table


def _row(scene: Scene, readings: Sequence["Reading"]) -> dict[str, Any]:
    from eitskin.training.evaluation.matching import match_distances
    from eitskin.training.method.targets import STATE_NAMES

    estimates = [reading.estimate for reading in readings if reading.estimate is not None]
    names = [str(getattr(e.state, "name", e.state)).lower() for e in estimates]
    truth = "touch" if scene.touches else "bend" if scene.bend.angle_deg else "idle"
    true = [(touch.x, touch.y) for touch in scene.touches]
    places = [[(float(x), float(y)) for x, y, _ in each.touches or ()] for each in estimates]
    found = places[-1]
    errors = match_distances(true, found) if true else []
    angles = [np.nan if e.bend_angle_deg is None else e.bend_angle_deg for e in estimates]
    latencies = [1e3 * float(reading.latency) for reading in readings]
    return {
        "true_state": truth,
        "state": max(STATE_NAMES, key=names.count),
        "right_frames": names.count(truth),
        "true_angle_deg": scene.bend.angle_deg,
        "angle_deg": float(np.median(angles)),
        "true_touches_mm": _millimetres(true),
        "touches_mm": _millimetres(found),
        "errors_mm": [1e3 * float(error) for error in errors],
        "latency_ms": float(np.median(latencies)),
        "states": names,
        "angles_deg": angles,
        "found_mm": [_millimetres(each) for each in places],
        "latencies_ms": latencies,
    }


def _millimetres(places: Sequence[tuple[float, float]]) -> list[list[float]]:
    return [[1e3 * x, 1e3 * y] for x, y in places]


def _places(places: Sequence[Sequence[float]]) -> str:
    return " ".join(f"({x:.0f},{y:.0f})" for x, y in places) or "-"
