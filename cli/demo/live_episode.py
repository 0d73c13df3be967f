"""The paper's episode on a virtual board: rows of results, and an animated SVG of them."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from eitskin.cli.page.commands import STEPS
from eitskin.geometry.deformation.fixtures import Bend
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.simulator import Simulator
from eitskin.training.evaluation.report.drawing import BLUE, DARK, GREY, ORANGE, PALE

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


WIDTH, HEIGHT = 900, 800  # of the picture, in its own units
SECONDS = 1.8  # for which each step of the episode is shown
FILM_FRAMES = 4  # of each step that are shown, evenly spaced
TURN, TILT = np.radians((28.0, 38.0))  # of the view, about z and above the horizon
ORIGIN, ENLARGED = (450.0, 320.0), 4410.0  # of the sensor's middle [units]; units per metre
TRACE = (90.0, 540.0, 780.0, 200.0)  # box of the angle's trace: left, top, width, height
COLOURS = {"idle": GREY, "touch": ORANGE, "bend": BLUE}
FACES = {"idle": "#c9d3dc", "touch": "#f4c9ab", "bend": "#b9d8ee"}
_LARGE = 'y="70" font-size="46" font-weight="650"'
_DASHED = f'fill="none" stroke="{DARK}" stroke-width="2.5" stroke-dasharray="9 7"'

Array = NDArray[np.float64]


def episode_film(rows: Sequence[Mapping[str, Any]], design: SensorDesign) -> bytes:
    """Animated picture of the rows of `run_episode`, without scripts.

    The sheet is bent by the estimated angle as the simulator bends it; its dashed outline by the
    true one. Discs are estimated touches, rings true ones. Where nothing moves, as on paper, the
    moment with most touches is shown.
    """
    moments = [
        (row, round(k))
        for row in rows
        for k in np.unique(np.linspace(0, len(row["states"]) - 1, FILM_FRAMES).round())
    ]
    angles = [float(np.nan_to_num(row["angles_deg"][k])) for row, k in moments]
    shown = max(range(len(moments)), key=lambda n: (len(moments[n][0]["true_touches_mm"]), n))
    view = _View(design)

    def animated(attribute: str, values: Sequence[str], how: str = "discrete") -> str:
        return (
            f'<animate attributeName="{attribute}" dur="{SECONDS * len(rows):g}s" calcMode="{how}" '
            f'repeatCount="indefinite" values="{";".join(values)}"/>'
        )

    def sheet(draw: Callable[[float], str], look: str, fill: str = "") -> str:
        paths = [draw(angle) for angle in angles]
        moving = animated("d", [*paths, paths[0]], "linear")
        return f'<path d="{paths[shown]}" {look}>{moving}{fill}</path>'

    faces = [FACES.get(row["states"][k], "#ffffff") for row, k in moments]
    face, fill = f'fill="{faces[shown]}" stroke="{DARK}"', animated("fill", faces)
    parts = [
        sheet(view.sides, f'{face} stroke-width="2" fill-opacity="0.7"', fill),
        sheet(view.rim, f'{face} stroke-width="3"', fill),
        sheet(view.net, 'fill="none" stroke="#fff" stroke-width="2" stroke-opacity="0.8"'),
        *_trace(rows),
    ]
    for n, (row, k) in enumerate(moments):
        seen = animated("opacity", [str(int(m == n)) for m in range(len(moments))])
        where = TRACE[0] + TRACE[2] * (n + 0.5) / len(moments)
        content = _moment(row, k, angles[n], where, view)
        parts.append(f'<g opacity="{int(n == shown)}">{seen}{content}</g>')
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" '
        'font-family="system-ui, DejaVu Sans, sans-serif" font-size="27">'
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#ffffff"/>{"".join(parts)}</svg>\n'
    ).encode()


def _moment(row: Mapping[str, Any], k: int, angle: float, where: float, view: "_View") -> str:
    """One frame of a step: touches, words, the true outline, and a line in the trace."""
    true = row["true_angle_deg"]
    found = [view.touch(angle, at, 24, f'fill="{ORANGE}"') for at in row["found_mm"][k]]
    rings = [view.touch(true, at, 34, _DASHED) for at in row["true_touches_mm"]]
    states = [
        f'<text x="{x}" {_LARGE} fill="{colour}"'
        f' opacity="{1 if state == row["states"][k] else 0.15}">{state}</text>'
        for (state, colour), x in zip(COLOURS.items(), (40, 175, 345), strict=True)
    ]
    return "".join(
        [
            *found,
            f'<path d="{view.rim(true)}" {_DASHED}/>',
            *rings,
            *states,
            f'<text x="860" {_LARGE} text-anchor="end" fill="{BLUE}">{_degrees(angle)}</text>',
            f'<text x="860" y="108" text-anchor="end" fill="{DARK}">true {_degrees(true)}</text>',
            f'<path d="M{where:.0f} {TRACE[1]:.0f}v{TRACE[3]:.0f}" stroke="{DARK}" '
            'stroke-width="3" stroke-opacity="0.35"/>',
        ]
    )


class _View:
    """Lines and touches of the bent layer as they are seen, for any angle [deg]."""

    def __init__(self, design: SensorDesign) -> None:
        self._sim = Simulator(design, "fast")
        self.length, self.width = design.outline.length, design.outline.width
        self.thickness = design.thickness
        self._along = self.length * np.concatenate([[0.0], np.linspace(0.3, 0.7, 9), [1.0]])

    @lru_cache(maxsize=512)  # noqa: B019  a view lives as long as one picture
    def _deformation(self, angle: float) -> Any:
        return self._sim.deformation(Scene(Bend(angle)))

    def line(self, angle: float, x: Any, y: Any, z: float | None = None) -> Array:
        """Points (n, 2) of a line of the layer, of its top face where no height [m] is given."""
        height = self.thickness if z is None else z
        points = np.stack(np.broadcast_arrays(*np.atleast_1d(x, y, height)), -1).astype(float)
        moved = self._deformation(round(angle, 1)).positions(points) if round(angle, 1) else points
        x, y, z = (moved - (self.length / 2, self.width / 2, self.thickness / 2)).T
        back = y * np.cos(TURN) - x * np.sin(TURN)
        seen = x * np.cos(TURN) + y * np.sin(TURN), -z * np.cos(TILT) - back * np.sin(TILT)
        return np.asarray(ORIGIN + ENLARGED * np.stack(seen, axis=-1))

    def rim(self, angle: float) -> str:
        """The top face."""
        front, back = (self.line(angle, self._along, y) for y in (0.0, self.width))
        return _path(np.vstack([front, back[::-1]])) + "z"

    def sides(self, angle: float) -> str:
        """The face towards the viewer, and the end at large x."""
        top, bottom = (self.line(angle, self._along, 0.0, z) for z in (None, 0.0))
        upper, lower = (self.line(angle, self.length, (0.0, self.width), z) for z in (None, 0.0))
        sides = (np.vstack([top, bottom[::-1]]), np.vstack([upper, lower[::-1]]))
        return "".join(_path(side) + "z" for side in sides)

    def net(self, angle: float) -> str:
        """Lines that are straight and evenly spaced while the layer is flat."""
        along = [self.line(angle, self._along, self.width * part / 4) for part in (1, 2, 3)]
        ends = (0.0, self.width)
        across = [self.line(angle, self.length * part / 10, ends) for part in range(1, 10)]
        return "".join(map(_path, (*along, *across)))

    def touch(self, angle: float, place: Sequence[float], radius: float, look: str) -> str:
        """A touch at a place [mm] of the top face, as an ellipse on it."""
        ((x, y),) = self.line(angle, 1e-3 * place[0], 1e-3 * place[1])
        shape = f'rx="{radius}" ry="{radius * np.sin(TILT):.0f}"'
        return f'<ellipse cx="{x:.0f}" cy="{y:.0f}" {shape} {look}/>'


def _path(points: Array) -> str:
    """Path through points (n, 2), in whole units."""
    whole = np.rint(points).astype(int)
    steps = " ".join(f"{x} {y}" for x, y in np.diff(whole, axis=0))
    return f"M{whole[0, 0]} {whole[0, 1]}l{steps}"


def _degrees(angle: float) -> str:
    return f"{round(angle):+d}°" if round(angle) else "0°"


def _trace(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """True and estimated angle over all frames."""
    left, top, width, height = TRACE
    angles = np.nan_to_num(np.concatenate([row["angles_deg"] for row in rows]).astype(float))
    true = np.repeat([row["true_angle_deg"] for row in rows], [len(row["states"]) for row in rows])
    states = np.concatenate([row["states"] for row in rows])
    least, most = min(true.min(), angles.min()) - 5.0, max(true.max(), angles.max()) + 5.0
    x = left + width * (np.arange(len(true)) + 0.5) / len(true)

    def y(angle: Any) -> Any:
        return top + height * (most - np.asarray(angle)) / (most - least)

    for angle in range(int(np.ceil(least / 20.0)) * 20, int(most) + 1, 20):
        yield (
            f'<path d="M{left:.0f} {y(angle):.0f}h{width:.0f}" stroke="{PALE}" stroke-width="2"/>'
            f'<text x="{left - 14:.0f}" y="{y(angle) + 9:.0f}" text-anchor="end" '
            f'fill="{GREY}">{angle}°</text>'
        )
    line = _path(np.stack([x, y(true)], axis=-1))
    yield f'<path d="{line}" fill="none" stroke="{DARK}" stroke-width="2"/>'
    for at, angle, state in zip(x, y(angles), states, strict=True):
        yield f'<circle cx="{at:.0f}" cy="{angle:.0f}" r="4" fill="{COLOURS.get(state, DARK)}"/>'
    yield (
        f'<text x="{left + width:.0f}" y="{top + height + 45:.0f}" text-anchor="end" '
        f'fill="{GREY}">bend angle over {len(true)} frames</text>'
    )
