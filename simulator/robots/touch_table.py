"""Touches of a robot's contacts, and a table of the measurements of one, for fast frames."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import NdBSpline, make_interp_spline

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import Rectangle
from eitskin.simulator.deformation.solution_store import Arrays, Problem, load_or_solve
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.scene.indenters import Cylinder
from eitskin.simulator.scene.scene import AnyIndenter, Scene, Touch
from eitskin.simulator.simulator import Simulator

Array = NDArray[np.float64]
SPACING = 0.0025  # m, at most, between places of the table
FORCES = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 3 / 4, 1.0)  # over the strongest
_APART, _SAME_PLACE = 1e-6, 1e-9  # spare between indenters, relative; of two places [m]
# Longest side of a face that one cylinder stands for, over the short one, and least radius [m].
_COMPACT, _LEAST_RADIUS = 1.5, 1e-3
FEWEST = 4  # places along an axis, for cubic splines
_VERSION = 1  # raise it whenever the table is solved in another way


@dataclass(frozen=True, slots=True)
class TouchRules:
    """Which contacts become touches, and within which limits.

    The defaults keep every touch within the tables of the reference sensor.

    Attributes:
        indenter: of all touches; None for the shape of the body that presses: of a sphere or
            capsule its `Sphere`, of a cylinder its flat end, of others `Cylinder`s as wide as the
            face between their contacts.
            Presses by other indenters than the default one are solved scene by scene, which takes
            half a minute each, unless the simulator has `touch_model="tabulated"`.
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

    def applied(self, points: Iterable[Touch], outline: Rectangle) -> tuple[Touch, ...]:
        """Touches of the points of contact on a gel of this outline, strongest first.

        Points whose indenters would overlap are one touch: their forces are added, at the mean
        place weighted by force, with the indenter of the strongest.
        """
        margin = min(self.margin, outline.length / 2, outline.width / 2)
        inside = [
            replace(
                point,
                x=min(max(point.x, margin), outline.length - margin),
                y=min(max(point.y, margin), outline.width - margin),
            )
            for point in points
        ]
        strong = [touch for touch in merged(inside) if touch.force >= self.least]
        limited = [replace(touch, force=min(touch.force, self.most)) for touch in strong]
        return tuple(sorted(limited, key=lambda touch: (-touch.force, touch.x, touch.y)))


def merged(touches: Iterable[Touch]) -> list[Touch]:
    """Touches of which no indenters overlap; those that overlap most are merged first."""
    found = list(touches)
    while True:
        overlaps = [
            (_overlap(found[i], found[j]), i, j) for i, j in combinations(range(len(found)), 2)
        ]
        most, i, j = max(overlaps, default=(0.0, 0, 0))
        if most <= 0.0:
            return found
        one, other = found[i], found.pop(j)
        force = one.force + other.force
        share = other.force / force
        strongest = one if one.force >= other.force else other
        found[i] = replace(
            strongest,
            x=one.x + share * (other.x - one.x),
            y=one.y + share * (other.y - one.y),
            force=force,
        )


def touches_of_face(contacts: Array, indenter: AnyIndenter | None) -> list[Touch]:
    """Touches that stand for one rigid face, which rests on some points of its rim.

    The face fills the least rectangle around its points. So many indenters as it holds side by side
    fill that, with forces that vary linearly along both sides and have the moments of the contacts.

    Args:
        contacts: places and forces (x, y, force) of the points, (n, 3) [m, m, N].
        indenter: of every touch; when None a cylinder as large as the face, or as wide as one that
            is longer than wide.
    """
    places, forces = contacts[:, :2], contacts[:, 2]
    pressed, total = forces @ places / forces.sum(), float(forces.sum())
    (low, high), axes = _least_rectangle(places)
    if indenter is None:
        short, long = np.sort(high - low).tolist()
        if short <= 2.0 * _LEAST_RADIUS:
            indenter = Cylinder()
        else:
            compact = long <= _COMPACT * short
            indenter = Cylinder(math.sqrt(short * long / math.pi) if compact else 0.5 * short)
    wide = 2.0 * indenter.rims[1] * (1.0 + _APART)
    counts = np.maximum(np.rint((high - low) / wide), 1.0).astype(int)
    if counts.prod() == 1:
        return [Touch(float(pressed[0]), float(pressed[1]), total, indenter)]
    # A single row lies where its side's moment is, others about the middle.
    middle = np.where(counts == 1, axes @ pressed, 0.5 * (low + high))
    rows = [
        np.linspace(-0.5, 0.5, n) * max(extent - wide, (n - 1) * wide) if n > 1 else np.zeros(1)
        for n, extent in zip(counts, high - low, strict=True)
    ]
    own = np.stack(np.meshgrid(*rows, indexing="ij"), axis=-1).reshape(-1, 2)
    spread = np.maximum((own**2).sum(axis=0), wide**2 * 1e-6)
    shares = 1.0 / len(own) + own @ ((axes @ pressed - middle) / spread)
    shares = np.maximum(shares, 0.0)
    there = (own + middle) @ axes
    return [
        Touch(float(x), float(y), float(share * total / shares.sum()), indenter)
        for (x, y), share in zip(there, shares, strict=True)
        if share > 0.0
    ]


def _least_rectangle(places: Array) -> tuple[tuple[Array, Array], Array]:
    """Least and greatest coordinates of points (n, 2) along both sides of their least rectangle.

    Second the directions of its sides, (2, 2), the long one first.
    """
    steps = np.concatenate([np.array([[1.0, 0.0]]), *(places - place for place in places)])
    steps = steps[np.hypot(*steps.T) > _SAME_PLACE]
    along = steps / np.hypot(*steps.T)[:, None]
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    extents = np.ptp(places @ along.T, axis=0), np.ptp(places @ across.T, axis=0)
    # Around points in a row all rectangles are equally small: that with the longest first side.
    best = np.lexsort((-extents[0], np.round(extents[0] * extents[1], 12)))[0]
    axes = np.stack([along[best], across[best]])
    found = places @ axes.T
    return (found.min(axis=0), found.max(axis=0)), axes


def _overlap(one: Touch, other: Touch) -> float:
    """Length by which the indenters of two touches overlap [m]; negative where they do not."""
    apart = math.dist((one.x, one.y), (other.x, other.y))
    return one.indenter.rims[1] + other.indenter.rims[1] - apart


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
    def solved(
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
        points = np.array([(each.x, each.y, each.force) for each in touches]).reshape(-1, 3)
        real, imaginary = np.split(self._spline(points), 2, axis=1)
        return np.asarray(np.exp(real + 1j * imaginary))


def _axes(outline: Rectangle, rules: TouchRules, spacing: float) -> tuple[Array, Array, Array]:
    """Places along x and y [m] and forces [N] at which touches are solved."""

    def along(length: float) -> Array:
        margin = min(rules.margin, length / 3)
        count = int(np.ceil((length - 2.0 * margin) / spacing - 1e-9)) + 1
        return np.linspace(margin, length - margin, max(count, FEWEST))

    return along(outline.length), along(outline.width), rules.most * np.array(FORCES)


def _logarithms(
    simulator: Simulator, scenes: Sequence[Scene], instrument: Instrument | None
) -> Array:
    """Logarithms of all measurements, real parts before imaginary ones, (scenes, values)."""
    solved = simulator.measure_all(scenes, instrument=instrument)
    logarithms = np.log(solved.reshape(len(scenes), -1))
    return np.concatenate([logarithms.real, logarithms.imag], axis=1)
