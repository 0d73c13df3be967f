"""Table of corrections of a press on a disc: over its distance from the middle and its depth."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import Disc
from eitskin.geometry.design.sensor import Support
from eitskin.simulator.mechanics.axisymmetric_press import Indentation
from eitskin.simulator.mechanics.layer_stack import Mechanics, Stack
from eitskin.simulator.mechanics.processes import solved_places
from eitskin.simulator.presses.correction_table import (
    DEPTHS,
    SAME,
    Report,
    across_strip,
    dents_to,
    distances_from_side,
    least_distance,
    rising_corrections,
    weights_over_depth,
)
from eitskin.simulator.presses.fields.spline_field import SplineField
from eitskin.simulator.presses.fields.turned_field import TurnedField
from eitskin.simulator.presses.finite_stack import Correction
from eitskin.simulator.presses.stack_mesh import Contact, Fineness, stack_mesh
from eitskin.simulator.scene.indenters import Indenter

Array = NDArray[np.float64]

_FINENESS = Fineness(ends=0.0, sides=0.0, layers=1)  # as of presses that are solved on a disc
# Splines of the fields: cells over the thickness of the stack, and a length over the radius, to
# which they reach. One layer of quadratic cells is a quadratic over the height.
_CELL, _REACH, _DEGREE = 0.2, 1.01, 2
# Displacement and mean stress turned by half a turn about the vertical.
_HALF_TURN = np.array([-1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class DiscTable:
    """Corrections of presses of one indenter on a disc, by distance from the rim and depth.

    By symmetry a press at any azimuth is one on the x axis, turned about the middle. Fields hold
    the displacement [m] and the mean stress [Pa] of the gel, from the middle of the disc.

    Attributes:
        thickness: of the whole stack, () [m].
        radius: of the gel, () [m].
        height: of the gel, () [m].
        aside: distances of solved presses from the rim, the last in the middle, (m,) [m].
        depths: of solved presses, rising from 0, (d,) [m].
        nodes: of the splines along x and y, (n,) [m].
        fields: coefficients of `SplineField` of presses at positive x, (m, d - 1, n, n, nz, 4).
        sunk: by which presses sink deeper than in an unbounded stack, (m, d - 1) [m].
    """

    thickness: Array
    radius: Array
    height: Array
    aside: Array
    depths: Array
    nodes: Array
    fields: Array
    sunk: Array

    def at(self, x: float, y: float, depth: float) -> tuple[TurnedField, float]:
        """Correction of a press at (x, y) to a depth [m], and how much it sinks [m]."""
        radius = float(self.radius)
        distance = math.dist((x, y), (radius, radius))
        cos, sin = 1.0, 0.0
        if distance > SAME:
            cos, sin = (x - radius) / distance, (y - radius) / distance
        # A press beyond the middle is one on this side, turned by half a turn.
        across = across_strip(self.aside, 2.0 * radius, radius - distance)
        deep = weights_over_depth(self.depths, depth)
        weights = (across[:, :, None] * deep).reshape(2, -1).astype(self.fields.dtype)
        shape = self.fields.shape[2:]
        here, there = (weights @ self.fields.reshape(-1, math.prod(shape))).reshape(2, *shape)
        coefficients = here + there[::-1, ::-1] * _HALF_TURN
        field = SplineField((self.nodes, self.nodes), float(self.height), coefficients)
        sunk = float(across.sum(axis=0) @ self.sunk @ deep)
        return TurnedField(field, radius, radius, cos, sin), sunk

    def covers(self, x: float, y: float) -> bool:
        """Whether the contact of a press at (x, y) [m] is on the stack."""
        radius = float(self.radius)
        return radius - math.dist((x, y), (radius, radius)) >= float(self.aside[0]) - SAME


def solve_disc(
    outline: Disc,
    stack: Stack,
    mechanics: Mechanics,
    support: Support,
    indenter: Indenter,
    report: Report | None = None,
    workers: int = 1,
) -> DiscTable:
    """Solve presses between the middle of a disc and its rim, at rising depths.

    Args:
        outline: of the gel.
        stack: the layers.
        mechanics: margin beside the gel, and its material.
        support: of the base, alike everywhere.
        indenter: rigid body that presses.
        report: called with the number of positions done and their total.
        workers: processes.

    Raises ConfigurationError for an indenter too large for the disc, SolidError where a press is
    not carried.
    """
    H = stack.levels[-1]
    aside = distances_from_side(least_distance(stack, mechanics, indenter), H, outline.radius)
    if len(aside) < 2:
        raise ConfigurationError(
            f"an indenter of {1e3 * indenter.rims[1]:.1f} mm radius leaves no room for a table on "
            f"a disc of {1e3 * outline.radius:.1f} mm radius; use touch_model='solved'"
        )
    dents = tuple(dents_to(stack, indenter, [part * H for part in DEPTHS]))
    setting = _Setting(outline, stack, mechanics, support, indenter, dents)
    fields, sunk = solved_places(setting.solved, aside.tolist(), report, workers)
    return DiscTable(
        thickness=np.array(H),
        radius=np.array(outline.radius),
        height=np.array(stack.sheets[stack.gel].thickness),
        aside=aside,
        depths=np.array([0.0, *(dent.depth for dent in dents)]),
        nodes=setting.nodes,
        fields=fields,
        sunk=sunk,
    )


def in_series(report: Report | None, number: int, tables: int) -> Report | None:
    """Report of one table, by its number, among several of about the same length."""
    if report is None:
        return None

    def whole(done: int, total: int) -> None:
        report(number * total + done, tables * total)

    return whole


@dataclass(frozen=True, slots=True, eq=False)
class _Setting:
    """Stack and presses that all positions share."""

    outline: Disc
    stack: Stack
    mechanics: Mechanics
    support: Support
    indenter: Indenter
    dents: tuple[Indentation, ...]

    @property
    def nodes(self) -> Array:
        """Nodes of the splines, from the middle of the disc [m]."""
        reach = _REACH * self.outline.radius
        cells = max(4, math.ceil(reach / (_CELL * self.stack.levels[-1])))
        return np.linspace(-reach, reach, 2 * cells + 1)

    def solved(self, aside: float) -> tuple[Array, Array]:
        """Coefficients (d, n, n, nz, 4) of presses at a distance from the rim, and sinking (d,)."""
        radius = self.outline.radius
        x, y = 2.0 * radius - aside, radius
        contacts = [Contact(x, y, self.indenter.rims[1])]
        body = stack_mesh(
            self.outline, self.stack, self.mechanics, self.support, contacts, _FINENESS
        )
        found = rising_corrections(body, x, y, self.indenter, self.dents)
        height, nodes = self.stack.sheets[self.stack.gel].thickness, self.nodes
        middle = np.array([radius, radius, 0.0])
        fields = [
            SplineField.of(partial(_centred, each.in_gel, middle), (nodes, nodes), height, _DEGREE)
            for each in found
        ]
        return np.array([f.coefficients for f in fields]), _sinking(found)


def _centred(field: Callable[[Array], Array], middle: Array, points: Array) -> Array:
    """Values of a field at points from the middle of the disc."""
    return field(points + middle)


def _sinking(found: list[Correction]) -> Array:
    return np.array([each.sunk[0] for each in found])
