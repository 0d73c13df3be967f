"""Touches of a robot's contacts, and a table of the measurements of one, for fast frames."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import NdBSpline, make_interp_spline
from scipy.spatial import ConvexHull

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import Rectangle
from eitskin.simulator.deformation.solution_store import Arrays, Problem, load_or_solve
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.scene.indenters import Cylinder, Footprint, distance
from eitskin.simulator.scene.scene import AnyIndenter, Scene, Touch
from eitskin.simulator.simulator import Simulator

Array = NDArray[np.float64]
SPACING = 0.0025  # m, at most, between places of the table
FORCES = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 3 / 4, 1.0)  # over the strongest
_LEAST_RADIUS, _ROUNDED = 1e-3, 5e-4  # half the width of an edge; of corners of faces [m]
MIN_PLACES = 4  # places along an axis, for cubic splines
_VERSION = 1  # raise it whenever the table is solved in another way


@dataclass(frozen=True, slots=True)
class TouchRules:
    """Which contacts become touches, and within which limits.

    The defaults keep every touch within the tables of the reference sensor.

    Attributes:
        indenter: indenter of all touches by faces that are not larger; None for the shape of the
            body that presses: presses of a sphere or capsule its `Sphere`, of a cylinder its flat
            end. Faces are `Footprint`s, which are the hulls of their contacts. Presses by other
            indenters than the default one are solved scene by scene, which takes half a minute or
            more each; those of bodies of revolution are tabulated where the simulator has
            `touch_model="tabulated"`.
        least: weakest touch [N]; weaker ones are none.
        most: strongest touch [N]; stronger ones press as strongly as this.
        margin: least distance from the edge of the gel [m]; touches nearer to it are moved in.
    """

    indenter: AnyIndenter | None = field(default_factory=Cylinder)
    least: float = 0.05
    most: float = 12.0
    margin: float = 0.005

    def __post_init__(self) -> None:
        if not 0.0 < self.least < self.most < math.inf:
            raise ConfigurationError(
                f"expected 0 < least < most, forces in N, got {self.least} and {self.most}"
            )
        if not 0.0 <= self.margin < math.inf:
            raise ConfigurationError(f"expected a margin of 0 m or more, got {self.margin}")

    def apply(self, points: Iterable[Touch], outline: Rectangle) -> tuple[Touch, ...]:
        """Touches of the points of contact on a gel of this outline, strongest first.

        Points whose indenters would overlap are one touch: their forces are added, at the mean
        place weighted by force, with the indenter of the strongest.
        """
        extents = np.array([outline.length, outline.width])
        inside = []
        for point in points:
            low = high = np.minimum(self.margin, extents / 2)
            if isinstance(point.indenter, Footprint):
                low, high = (point.indenter.reach(way * np.eye(2)) for way in (-1.0, 1.0))
            x, y = np.clip([point.x, point.y], low, np.maximum(extents - high, low)).tolist()
            inside.append(replace(point, x=x, y=y))
        strong = [touch for touch in merge_overlapping(inside) if touch.force >= self.least]
        limited = [replace(touch, force=min(touch.force, self.most)) for touch in strong]
        return tuple(sorted(limited, key=lambda touch: (-touch.force, touch.x, touch.y)))


def merge_overlapping(touches: Iterable[Touch]) -> list[Touch]:
    """Touches of which no indenters overlap; those that overlap most are merged first."""
    found = list(touches)
    while True:
        overlaps = [
            (_overlap(found[i], found[j]), i, j) for i, j in combinations(range(len(found)), 2)
        ]
        most, i, j = max(overlaps, default=(0.0, 0, 0))
        if most <= 0.0:
            return found
        first, second = found[i], found.pop(j)
        force = first.force + second.force
        share = second.force / force
        strongest = first if first.force >= second.force else second
        found[i] = replace(
            strongest,
            x=first.x + share * (second.x - first.x),
            y=first.y + share * (second.y - first.y),
            force=force,
        )


def touch_of_face(contacts: Array, indenter: AnyIndenter | None) -> Touch:
    """Touch of one rigid face, which rests on some points of its rim.

    The face is the hull of its points; the force acts where that of the contacts does.

    Args:
        contacts: places and forces (x, y, force) of the points, (n, 3) [m, m, N].
        indenter: indenter of faces that are not larger; when None of single points.
    """
    places, forces = contacts[:, :2], contacts[:, 2]
    pressed, total = forces @ places / forces.sum(), float(forces.sum())
    corners = _hull(places) - pressed
    point = indenter or Cylinder()
    widest = 2.0 * (point.rims[1] if indenter else _LEAST_RADIUS)
    if len(corners) < 3 or np.ptp(corners, axis=0).max() <= widest:
        return Touch(float(pressed[0]), float(pressed[1]), total, point)
    # Shapes are solved once; those of later frames differ by less than this.
    rounded = np.trunc(corners / _ROUNDED) * _ROUNDED
    footprint = Footprint(corners=tuple(map(tuple, _hull(rounded).tolist())))
    return Touch(float(pressed[0]), float(pressed[1]), total, footprint)


def _hull(places: Array) -> Array:
    """Corners of the hull of places, at least as wide as a needle, (n, 2) [m], anticlockwise."""
    steps = places - places[0]
    far = steps[np.hypot(*steps.T).argmax()]
    if not np.hypot(*far) > _LEAST_RADIUS:
        return places[:1]
    across = np.array([-far[1], far[0]]) / np.hypot(*far)
    if np.ptp(places @ across) < 2.0 * _LEAST_RADIUS:  # an edge
        places = np.concatenate([places + way * _LEAST_RADIUS * across for way in (-1.0, 1.0)])
    return np.asarray(places[ConvexHull(places).vertices])


def _overlap(one: Touch, other: Touch) -> float:
    """Length by which the indenters of two touches overlap [m]; negative where they do not."""
    return -distance(one.indenter, other.indenter, np.array([other.x - one.x, other.y - one.y]))


class TouchTable:
    """Changes of the logarithm of all measurements by one touch, over place and force.

    Between the solved touches they are cubic splines. Changes of several touches are not their
    sum: neighbours that both press hard are a third of their signal off it.
    """

    def __init__(self, axes: tuple[Array, Array, Array], changes: Array) -> None:
        """Interpolate changes (x, y, force, values) at x [m], y [m] and forces [N], from 0 N on."""
        knots, coefficients = [], changes
        for axis, nodes in enumerate(axes):
            spline = make_interp_spline(nodes, coefficients, axis=axis)
            knots.append(spline.t)
            coefficients = np.moveaxis(spline.c, 0, axis)  # first, whatever the axis
        self._spline = NdBSpline(tuple(knots), coefficients, 3)

    @classmethod
    def load_or_solve(
        cls,
        simulator: Simulator,
        outline: Rectangle,
        indenter: AnyIndenter,
        rules: TouchRules,
        instrument: Instrument | None = None,
        spacing: float = SPACING,
    ) -> "TouchTable":
        """Table within some rules, from the user's folder for caches, or solved now and kept there.

        Solving takes as long as 7,200 scenes do for the reference sensor.
        """
        axes = _axes(outline, rules, spacing)
        flat = _logarithms(simulator, [Scene()], instrument)[0]
        sensor = simulator.design, simulator.mechanics, simulator.touch_model, simulator.grid
        described = {
            "version": _VERSION,
            "flat": flat.tolist(),
            "axes": [axis.tolist() for axis in axes],
            "sensor": repr(sensor),
            "indenter": repr(indenter),
        }

        def solve(_: object) -> Arrays:
            places = [Touch(x, y, f, indenter) for x in axes[0] for y in axes[1] for f in axes[2]]
            scenes = [Scene(touches=(touch,)) for touch in places]
            changes = _logarithms(simulator, scenes, instrument) - flat
            return {"changes": changes.reshape(*map(len, axes), len(flat))}

        changes = load_or_solve(Problem("touches", described, solve), dict)["changes"]
        # Without force nothing changes.
        forces = np.concatenate([[0.0], axes[2]])
        return cls((axes[0], axes[1], forces), np.pad(changes, [(0, 0), (0, 0), (1, 0), (0, 0)]))

    def factors(self, touches: Sequence[Touch]) -> NDArray[np.complex128]:
        """Measurements under each touch over those of the untouched sensor, (touches, values)."""
        points = np.array([(touch.x, touch.y, touch.force) for touch in touches]).reshape(-1, 3)
        real, imaginary = np.split(self._spline(points), 2, axis=1)
        return np.asarray(np.exp(real + 1j * imaginary))


def _axes(outline: Rectangle, rules: TouchRules, spacing: float) -> tuple[Array, Array, Array]:
    """Places along x and y [m] and forces [N] at which touches are solved."""

    def axis_positions(length: float) -> Array:
        margin = min(rules.margin, length / 3)
        count = int(np.ceil((length - 2.0 * margin) / spacing - 1e-9)) + 1
        return np.linspace(margin, length - margin, max(count, MIN_PLACES))

    return (
        axis_positions(outline.length),
        axis_positions(outline.width),
        rules.most * np.array(FORCES),
    )


def _logarithms(
    simulator: Simulator, scenes: Sequence[Scene], instrument: Instrument | None
) -> Array:
    """Logarithms of all measurements, real parts before imaginary ones, (scenes, values)."""
    solved = simulator.measure_all(scenes, instrument=instrument)
    logarithms = np.log(solved.reshape(len(scenes), -1))
    return np.concatenate([logarithms.real, logarithms.imag], axis=1)
