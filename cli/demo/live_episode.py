"""The paper's episode on a virtual board: rows of results, and a moving picture of them."""

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table

from eitskin.cli.page.commands import STEPS
from eitskin.cli.page.drawing import INSIDE, METAL, GelShape
from eitskin.cli.page.plan import outline_of
from eitskin.cli.terminal import table_of
from eitskin.extras import require
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.scene.scene import Scene
from eitskin.training.evaluation.drawing import (
    BLUE,
    DARK,
    EXTRA,
    GREY,
    ORANGE,
)

if TYPE_CHECKING:
    from eitskin.hardware.live import FramePipeline, Reading

FRAMES = 12  # of each step

COLUMNS = ("true", "state", "angle, deg", "touches: true", "found", "error, mm", "ms/frame")


def run_episode(pipeline: "FramePipeline", seed: int, frames: int = FRAMES) -> list[dict[str, Any]]:
    """Play the episode through a virtual board and `pipeline`; one row of results per step.

    Every frame comes as packets, as from a real board. A row holds the state
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
    return table_of(COLUMNS, map(episode_cells, rows))


def _row(scene: Scene, readings: Sequence["Reading"]) -> dict[str, Any]:
    from eitskin.training.evaluation.scores import match_distances
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


FILM_FRAMES = 4  # of each step that are shown, evenly spaced
MILLISECONDS = 450  # for which each is shown
FACES = {"idle": "#c9d3dc", "touch": "#f4c9ab", "bend": "#b9d8ee"}
COLOURS = {"idle": GREY, "touch": ORANGE, "bend": BLUE}


def episode_film(rows: Sequence[Mapping[str, Any]], design: SensorDesign) -> bytes:
    """Moving picture (WebP) of the rows of `run_episode`.

    It begins with the moment of most touches, which is what paper shows.
    """
    shape = GelShape.of(design)
    moments = [
        (row, round(k))
        for row in rows
        for k in np.unique(np.linspace(0, len(row["states"]) - 1, FILM_FRAMES).round())
    ]
    fullest = max(range(len(moments)), key=lambda n: len(moments[n][0]["true_touches_mm"]))
    order = [*range(fullest, len(moments)), *range(fullest)]
    images = [_draw_moment(shape, rows, moments[n], n / len(moments)) for n in order]
    file = io.BytesIO()
    how: dict[str, Any] = {"duration": MILLISECONDS, "loop": 0, "quality": 80}
    images[0].save(file, "WEBP", save_all=True, append_images=images[1:], **how)
    return file.getvalue()


def _draw_moment(
    shape: GelShape,
    rows: Sequence[Mapping[str, Any]],
    moment: tuple[Mapping[str, Any], int],
    when: float,
) -> Any:
    """Image of a step's frame: the sensor as estimated and as it is, and all angles."""
    row, k = moment
    figure = require("matplotlib.figure", EXTRA).Figure(figsize=(6.5, 5.8))
    sensor = figure.add_axes((0.0, 0.1, 1.0, 1.12), projection="3d")  # a square as wide
    state, angle = row["states"][k], float(np.nan_to_num(row["angles_deg"][k]))
    _draw_sensor(sensor, shape, state, angle, row["found_mm"][k])
    _draw_truth(sensor, shape, row["true_angle_deg"], row["true_touches_mm"])
    figure.suptitle(
        f"{state}, {round(angle)} deg (true {row['true_angle_deg']:.0f} deg)",
        color=COLOURS.get(state, DARK),
    )
    _draw_angles(figure.add_axes((0.1, 0.09, 0.86, 0.27)), rows, when)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=110)
    return require("PIL.Image", EXTRA).open(file).convert("RGB")


def _draw_sensor(
    axes: Any, shape: GelShape, state: str, angle: float, places: Sequence[Sequence[float]]
) -> None:
    """The sensor as estimated, bent and dented, with discs where touches are found."""
    body, kinds = shape.body, shape.body.kinds[shape.body.faces[:, 0]]
    points = 1e3 * shape.bent(angle, [(1e-3 * x, 1e-3 * y, np.nan) for x, y in places])
    colours = np.where((kinds == METAL) | (kinds == INSIDE), DARK, FACES.get(state, "#ffffff"))
    collection = require("mpl_toolkits.mplot3d.art3d", EXTRA).Poly3DCollection
    faces = points[body.vertices[body.faces]]
    axes.add_collection3d(collection(faces, facecolors=colours, shade=True, zorder=1))
    _draw_touches(axes, shape, angle, places, color=ORANGE, s=60, zorder=3)
    length, width = shape.design.outline.length * 1e3, shape.design.outline.width * 1e3
    axes.set(xlim=(0, length), ylim=(0, width), zlim=(-0.3 * length, 0.15 * length))
    axes.set_box_aspect((length, width, 0.45 * length), zoom=0.95)
    axes.computed_zorder = False
    axes.view_init(32.0, -62.0)
    axes.set_axis_off()


def _draw_truth(
    axes: Any, shape: GelShape, angle: float, places: Sequence[Sequence[float]]
) -> None:
    """Dashed outline of the sensor as it is, with rings where it is touched."""
    corners = outline_of(shape.design)
    steps = np.linspace(0.0, 1.0, 20)[:, None]
    sides = [
        a + steps * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)
    ]
    rim = np.concatenate(sides)
    top = np.column_stack([rim, np.full(len(rim), shape.design.thickness)])
    dashed = {"color": DARK, "linewidth": 1.2, "linestyle": "--", "zorder": 2}
    axes.plot(*(1e3 * shape.bent(angle, [], top)).T, **dashed)
    _draw_touches(axes, shape, angle, places, color="none", edgecolors=DARK, s=130, zorder=4)


def _draw_touches(
    axes: Any, shape: GelShape, angle: float, places: Sequence[Sequence[float]], **look: Any
) -> None:
    if len(places):
        top = [(1e-3 * x, 1e-3 * y, shape.design.thickness) for x, y in places]
        axes.scatter(*(1e3 * shape.bent(angle, [], np.array(top))).T, depthshade=False, **look)


def _draw_angles(axes: Any, rows: Sequence[Mapping[str, Any]], when: float) -> None:
    """True and estimated angle of all frames, and a line at one moment, a part of the episode."""
    true = np.repeat([row["true_angle_deg"] for row in rows], [len(row["states"]) for row in rows])
    states = np.concatenate([row["states"] for row in rows])
    colours = [COLOURS.get(state, DARK) for state in states]
    frames = np.arange(len(true))
    axes.step(frames, true, where="mid", color=DARK, linewidth=1.0)
    angles = np.concatenate([row["angles_deg"] for row in rows])
    axes.scatter(frames, angles, s=9, c=colours, zorder=3)
    axes.axvline(when * len(true), color=DARK, alpha=0.35, linewidth=2)
    axes.set(xlabel="frame", ylabel="bend angle [deg]")
