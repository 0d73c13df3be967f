"""The live episode as one animated SVG: the sensor as it was estimated, and the angle's trace."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.cli.demo.pictures import COLOURS as STATE_COLOURS
from eitskin.cli.demo.results import SVG, Picture
from eitskin.geometry.deformation.fixtures import Bend
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.simulator import Simulator
from eitskin.training.evaluation.report.drawing import BLUE, DARK, GREY, ORANGE, PALE

WIDTH, HEIGHT = 900, 800  # of the picture, in its own units
SECONDS = 1.8  # for which each step of the episode is shown
KEPT = 4  # frames of each step that are shown, evenly spaced
SLOTS = 4  # touches at once, at most
TURN, TILT = np.radians((28.0, 38.0))  # of the view, about z and above the horizon
ORIGIN, ENLARGED = (450.0, 320.0), 4410.0  # of the sensor's middle [units]; units per metre
STATE_AT = (40, 175, 345)  # of the three states' names
TRACE = (90.0, 540.0, 780.0, 200.0)  # box of the angle's trace: left, top, width, height
COLOURS = {state.name.lower(): colour for state, colour in STATE_COLOURS.items()}
FACES = {"idle": "#c9d3dc", "touch": "#f4c9ab", "bend": "#b9d8ee", "none": "#ffffff"}

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Moment:
    """One frame of the episode: its estimate beside the truth; angles [deg], places [mm]."""

    state: str
    angle: float
    places: tuple[tuple[float, float], ...]
    true_angle: float
    true_places: tuple[tuple[float, float], ...]


def episode_film(rows: Sequence[Mapping[str, Any]], design: SensorDesign) -> Picture:
    """Animated picture of the rows of `run_episode`, without scripts.

    The sheet is bent by the estimated angle as the simulator bends it; its dashed outline by the
    true one. Discs are estimated touches, rings true ones.
    """
    moments = _moments(rows)
    sheet = _Sheet(design)
    shown = max(range(len(moments)), key=lambda k: (len(moments[k].true_places), k))
    time = _Time(len(moments), SECONDS * len(rows), shown)
    parts = [*_words(moments, time), *_sheets(moments, sheet, time), *_trace(rows, time)]
    svg = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" '
        'font-family="system-ui, DejaVu Sans, sans-serif" font-size="27">'
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#ffffff"/>{"".join(parts)}</svg>\n'
    )
    caption = (
        "The sensor as the pipeline estimates it: bent by the estimated angle, coloured by the "
        "estimated state, discs where it finds touches. Dashed: the truth. Below, the estimated "
        "angle of every frame (dots) and the true one (line)."
    )
    alt = "Moving picture of the live episode: the sensor as estimated, beside the truth"
    return Picture(alt, caption, SVG, svg.encode(), 6.5)


def _moments(rows: Sequence[Mapping[str, Any]]) -> list[Moment]:
    """The frames that are shown."""
    found = []
    for row in rows:
        last = len(row["states"]) - 1
        for k in sorted({round(last * part / max(KEPT - 1, 1)) for part in range(KEPT)}):
            angle = row["angles_deg"][k]
            found.append(
                Moment(
                    row["states"][k],
                    angle if np.isfinite(angle) else 0.0,
                    _sorted(row["found_mm"][k]),
                    row["true_angle_deg"],
                    _sorted(row["true_touches_mm"]),
                )
            )
    return found


def _sorted(places: Iterable[Sequence[float]]) -> tuple[tuple[float, float], ...]:
    return tuple(sorted((float(x), float(y)) for x, y in places)[:SLOTS])


@dataclass(frozen=True, slots=True)
class _Time:
    """Values of an attribute over the film, repeated without end.

    Attributes:
        count: number of moments.
        seconds: duration of the film.
        shown: moment that stands still where nothing moves, as on paper.
    """

    count: int
    seconds: float
    shown: int

    def moving(self, attribute: str, values: Sequence[str]) -> str:
        """Attribute that moves from each value to the next, and from the last to the first."""
        return self._animate(attribute, [*values, values[0]], "linear")

    def stepping(self, attribute: str, values: Sequence[str]) -> str:
        """Attribute that jumps from each value to the next."""
        return self._animate(attribute, values, "discrete")

    def _animate(self, attribute: str, values: Sequence[str], how: str) -> str:
        return (
            f'<animate attributeName="{attribute}" dur="{self.seconds:g}s" calcMode="{how}" '
            f'repeatCount="indefinite" values="{";".join(values)}"/>'
        )


class _Sheet:
    """Points of the bent layer in the picture, for any angle."""

    def __init__(self, design: SensorDesign) -> None:
        self._sim = Simulator(design, "fast")
        self.length, self.width = design.outline.length, design.outline.width
        self.thickness = design.thickness
        bent = np.linspace(0.3, 0.7, 9)
        self.along = self.length * np.concatenate([[0.0], bent, [1.0]])

    @lru_cache(maxsize=512)  # noqa: B019  a sheet lives as long as one picture
    def _deformation(self, angle: float) -> Any:
        return self._sim.deformation(Scene(Bend(angle))) if angle else None

    def seen(self, angle: float, points: Array) -> Array:
        """Points (n, 3) [m] of the flat layer as they are seen, bent by `angle` [deg]: (n, 2)."""
        deformation = self._deformation(round(angle, 1))
        moved = points if deformation is None else deformation.positions(points)
        x, y, z = (moved - (self.length / 2, self.width / 2, self.thickness / 2)).T
        right = x * np.cos(TURN) + y * np.sin(TURN)
        back = -x * np.sin(TURN) + y * np.cos(TURN)
        up = z * np.cos(TILT) + back * np.sin(TILT)
        place = np.stack([right, -up], axis=-1)
        return np.asarray(ORIGIN + ENLARGED * place)

    def line(self, angle: float, x: Array | float, y: float, top: bool = True) -> Array:
        """A line of the layer as it is seen: along x where `x` has many values."""
        x = np.atleast_1d(np.asarray(x, dtype=float))
        height = self.thickness if top else 0.0
        return self.seen(angle, np.stack([x, 0 * x + y, 0 * x + height], axis=-1))

    def rim(self, angle: float) -> str:
        """The top face."""
        front, back = (self.line(angle, self.along, y) for y in (0.0, self.width))
        return _path(np.vstack([front, back[::-1]]), closed=True)

    def sides(self, angle: float) -> str:
        """The face towards the viewer, and the end at large x."""
        top, bottom = (self.line(angle, self.along, 0.0, top) for top in (True, False))
        ends = ((0.0, True), (self.width, True), (self.width, False), (0.0, False))
        corners = [self.line(angle, self.length, y, top) for y, top in ends]
        return _path(np.vstack([top, bottom[::-1]]), True) + _path(np.vstack(corners), True)

    def net(self, angle: float) -> str:
        """Lines that are straight and evenly spaced while the layer is flat."""
        along = [self.line(angle, self.along, self.width * part / 4) for part in (1, 2, 3)]
        across = [
            np.vstack([self.line(angle, self.length * k / 10, y) for y in (0.0, self.width)])
            for k in range(1, 10)
        ]
        return "".join(_path(line) for line in (*along, *across))

    def place(self, angle: float, place: tuple[float, float]) -> Array:
        """A place [mm] of the top face as it is seen, (2,)."""
        seen: Array = self.line(angle, 1e-3 * place[0], 1e-3 * place[1])[0]
        return seen


def _path(points: Array, closed: bool = False) -> str:
    """Path through points (n, 2), in whole units."""
    whole = np.rint(points).astype(int)
    steps = np.diff(whole, axis=0)
    begin, rest = " ".join(map(str, whole[0])), " ".join(f"{x} {y}" for x, y in steps)
    return f"M{begin}l{rest}{'z' if closed else ''}"


def _sheets(moments: Sequence[Moment], sheet: _Sheet, time: _Time) -> Iterable[str]:
    """The sensor as estimated, with its touches; dashed, as it is."""
    angles = [moment.angle for moment in moments]
    fill = time.stepping("fill", [FACES[moment.state] for moment in moments])
    face = FACES[moments[time.shown].state]
    for draw, look in (
        (sheet.sides, f'fill="{face}" stroke="{DARK}" stroke-width="2" fill-opacity="0.7"'),
        (sheet.rim, f'fill="{face}" stroke="{DARK}" stroke-width="3"'),
        (sheet.net, 'fill="none" stroke="#ffffff" stroke-width="2" stroke-opacity="0.8"'),
    ):
        paths = [draw(angle) for angle in angles]
        colour = "" if draw == sheet.net else fill
        yield f'<path d="{paths[time.shown]}" {look}>{time.moving("d", paths)}{colour}</path>'
    for slot in range(SLOTS):
        yield _touch([m.places for m in moments], angles, slot, sheet, time, f'fill="{ORANGE}"')
    true_angles = [moment.true_angle for moment in moments]
    dashed = f'fill="none" stroke="{DARK}" stroke-width="2.5" stroke-dasharray="9 7"'
    paths = [sheet.rim(angle) for angle in true_angles]
    yield f'<path d="{paths[time.shown]}" {dashed}>{time.stepping("d", paths)}</path>'
    for slot in range(SLOTS):
        yield _touch([m.true_places for m in moments], true_angles, slot, sheet, time, dashed, 34)


def _touch(
    places: Sequence[Sequence[tuple[float, float]]],
    angles: Sequence[float],
    slot: int,
    sheet: _Sheet,
    time: _Time,
    look: str,
    radius: float = 24,
) -> str:
    """The touch number `slot` of every moment: an ellipse on the sheet, absent where it is not."""
    at = [
        sheet.place(angle, each[slot]) if slot < len(each) else np.zeros(2)
        for angle, each in zip(angles, places, strict=True)
    ]
    values = {
        "cx": [f"{x:.0f}" for x, _ in at],
        "cy": [f"{y:.0f}" for _, y in at],
        "opacity": ["1" if slot < len(each) else "0" for each in places],
    }
    still = " ".join(f'{name}="{each[time.shown]}"' for name, each in values.items())
    moving = "".join(time.stepping(name, each) for name, each in values.items())
    shape = f'rx="{radius}" ry="{radius * np.sin(TILT):.0f}"'
    return f"<ellipse {still} {shape} {look}>{moving}</ellipse>"


def _words(moments: Sequence[Moment], time: _Time) -> Iterable[str]:
    """Estimated state and angle, and the true angle."""
    for (state, colour), x in zip(COLOURS.items(), STATE_AT, strict=True):
        seen = ["1" if moment.state == state else "0.15" for moment in moments]
        yield (
            f'<text x="{x}" y="70" font-size="46" font-weight="650" fill="{colour}" '
            f'opacity="{seen[time.shown]}">{state}{time.stepping("opacity", seen)}</text>'
        )
    for moment, texts in _runs([_degrees(each.angle) for each in moments]):
        seen = ["1" if k in texts else "0" for k in range(time.count)]
        yield (
            f'<text x="860" y="70" font-size="46" font-weight="650" text-anchor="end" '
            f'fill="{BLUE}" opacity="{seen[time.shown]}">{escape(moment)}'
            f"{time.stepping('opacity', seen)}</text>"
        )
    for moment, texts in _runs([f"true {_degrees(each.true_angle)}" for each in moments]):
        seen = ["1" if k in texts else "0" for k in range(time.count)]
        yield (
            f'<text x="860" y="108" text-anchor="end" fill="{DARK}" '
            f'opacity="{seen[time.shown]}">{escape(moment)}{time.stepping("opacity", seen)}</text>'
        )


def _degrees(angle: float) -> str:
    return f"{round(angle):+d}°" if round(angle) else "0°"


def _runs(texts: Sequence[str]) -> Iterable[tuple[str, set[int]]]:
    """Each text once, with the moments that have it."""
    return [(text, {k for k, each in enumerate(texts) if each == text}) for text in set(texts)]


def _trace(rows: Sequence[Mapping[str, Any]], time: _Time) -> Iterable[str]:
    """True and estimated angle over all frames, and a line at the moment that is shown."""
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
    where = left + width * (np.arange(time.count) + 0.5) / time.count
    values = [f"M{at:.0f} {top:.0f}v{height:.0f}" for at in where]
    cursor = f'stroke="{DARK}" stroke-width="3" stroke-opacity="0.35"'
    yield f'<path d="{values[time.shown]}" {cursor}>{time.stepping("d", values)}</path>'
    yield (
        f'<text x="{left + width:.0f}" y="{top + height + 45:.0f}" text-anchor="end" '
        f'fill="{GREY}">bend angle over {len(true)} frames</text>'
    )
