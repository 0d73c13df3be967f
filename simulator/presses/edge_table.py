"""Table of corrections of a press beside a straight side of a large stack."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.sensor import Support
from eitskin.simulator.mechanics.axisymmetric_press import Indentation
from eitskin.simulator.mechanics.cubic_splines import CubicSplines, spline_weights
from eitskin.simulator.mechanics.layer_stack import Mechanics, Stack
from eitskin.simulator.mechanics.processes import solved_places
from eitskin.simulator.presses.correction_table import (
    DEPTHS,
    Report,
    dents_to,
    least_distance,
    rising_corrections,
    weights_over_depth,
)
from eitskin.simulator.presses.fields.spline_field import SplineField
from eitskin.simulator.presses.finite_stack import Correction
from eitskin.simulator.presses.stack_mesh import Contact, Fineness, stack_mesh
from eitskin.simulator.scene.indenters import Indenter

Array = NDArray[np.float64]

# Lengths over the thickness of the stack.
_ASIDE = (0.0, 0.2, 0.45, 0.8, 1.25, 1.8, 2.5, 3.4, 4.6)  # from the side, beyond the least
_VANISHED = 1.9  # beyond the last distance
_REACH, _DEEP = 6.5, 7.5  # of the field along the side from the press, and from the side
_FADE, _FREE = 2.0, 1.0  # length over which it is faded out, and of the mesh beyond
_FINENESS = Fineness(ends=0.0, sides=0.1, layers=2, growth=1.0)
# Cells of the splines: even ones about the press, and wider ones beyond.
_EVEN, _CELL, _WIDE, _DEGREE = 2.5, 0.2, 0.5, 3
# Nodes beside the side, where stress is singular and electrodes lie. The first is beyond it, so
# that points on it are within.
_BESIDE = (-0.02, 0.0, 0.04, 0.09, 0.15, 0.22, 0.31, 0.44)


@dataclass(frozen=True, slots=True, eq=False)
class EdgeTable:
    """Corrections of presses of one indenter beside a straight side, by distance and depth.

    Fields hold the displacement [m] and the mean stress [Pa] of the gel, in a frame with x along
    the side from the foot of the press and y into the gel, from `middle`.

    Attributes:
        thickness: of the whole stack, () [m].
        height: of the gel, () [m].
        aside: distances of presses from the side; at the last nothing is corrected, (m + 1,) [m].
        depths: of solved presses, rising from 0, (d,) [m].
        along: nodes of the splines along x, (nx,) [m].
        inward: nodes of the splines along y, (ny,) [m].
        middle: distance of the middle of the fields from the side, () [m].
        fields: coefficients of `SplineField`, (m, d - 1, nx, ny, nz, 4).
        sunk: by which presses sink deeper than in an unbounded stack, (m, d - 1) [m].
    """

    thickness: Array
    height: Array
    aside: Array
    depths: Array
    along: Array
    inward: Array
    middle: Array
    fields: Array
    sunk: Array

    @property
    def reach(self) -> float:
        """Distance of a press from a side from which nothing is corrected [m]."""
        return float(self.aside[-1])

    @property
    def nodes(self) -> tuple[Array, Array]:
        """Nodes of the splines along and across the side [m]."""
        return self.along, self.inward

    def at(self, aside: Sequence[float], depth: float) -> tuple[Array, Array]:
        """Corrections of a press to a depth [m] beside sides at distances (n,) [m].

        Returns coefficients of the fields (n, nx, ny, nz, 4) and sinkings (n,) [m].
        """
        least = float(self.aside[0])
        beside = np.array([spline_weights(self.aside, max(each, least))[:-1] for each in aside])
        deep = weights_over_depth(self.depths, depth)
        shape = self.fields.shape[2:]
        amounts = (beside[:, :, None] * deep).reshape(len(beside), -1).astype(self.fields.dtype)
        fields = amounts @ self.fields.reshape(-1, math.prod(shape))
        return fields.reshape(len(beside), *shape), beside @ self.sunk @ deep

    def resampled(self, other: "EdgeTable") -> "EdgeTable":
        """The same table with splines on the nodes of another."""
        nodes = other.along, other.inward
        if np.array_equal(self.along, other.along) and np.array_equal(self.inward, other.inward):
            return self
        lengths = self.along, self.inward + float(self.middle - other.middle)
        along, inward = (
            CubicSplines(new).fit @ CubicSplines(own).at(new)
            for own, new in zip(lengths, nodes, strict=True)
        )
        fields = np.einsum("ai,bj,mdijlk->mdablk", along, inward, self.fields, optimize=True)
        return EdgeTable(
            self.thickness,
            self.height,
            self.aside,
            self.depths,
            *nodes,
            other.middle,
            fields.astype(self.fields.dtype),
            self.sunk,
        )


def solve_edge(
    stack: Stack,
    mechanics: Mechanics,
    support: Support,
    indenter: Indenter,
    report: Report | None = None,
    workers: int = 1,
) -> EdgeTable:
    """Solve presses beside a long side of a wide stack, at rising depths.

    Args:
        stack: the layers.
        mechanics: margin beside the gel, and its material.
        support: of the base, alike everywhere.
        indenter: rigid body that presses.
        report: called with the number of distances done and their total.
        workers: processes.

    Raises SolidError where a press is not carried.
    """
    H = stack.levels[-1]
    dents = dents_to(stack, indenter, [part * H for part in DEPTHS])
    setting = _Setting(stack, mechanics, support, indenter, tuple(dents))
    aside = least_distance(stack, mechanics, indenter) + H * np.array(_ASIDE)
    fields, sunk = solved_places(setting.solved, aside.tolist(), report, workers)
    along, inward = setting.nodes
    return EdgeTable(
        thickness=np.array(H),
        height=np.array(stack.sheets[stack.gel].thickness),
        aside=np.append(aside, aside[-1] + _VANISHED * H),
        depths=np.array([0.0, *(dent.depth for dent in dents)]),
        along=along,
        inward=inward,
        middle=np.array(setting.middle),
        fields=fields,
        sunk=sunk,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Setting:
    """Stack and presses that all distances share."""

    stack: Stack
    mechanics: Mechanics
    support: Support
    indenter: Indenter
    dents: tuple[Indentation, ...]

    @property
    def middle(self) -> float:
        """Distance of the middle of the fields from the side [m]."""
        return 0.5 * (_DEEP + _BESIDE[0]) * self.stack.levels[-1]

    @property
    def nodes(self) -> tuple[Array, Array]:
        """Nodes of the splines along and across the side [m]."""
        H = self.stack.levels[-1]
        half = _cells(_REACH)
        cells = _cells(_DEEP)
        inward = np.append(_BESIDE, cells[cells > _BESIDE[-1] + 0.5 * _CELL])
        return H * np.append(-half[:0:-1], half), H * inward - self.middle

    def solved(self, aside: float) -> tuple[Array, Array]:
        """Coefficients (d, nx, ny, nz, 4) of presses at a distance [m], and sinking (d,) [m]."""
        H, height = self.stack.levels[-1], self.stack.sheets[self.stack.gel].thickness
        x = (_REACH + _FREE) * H
        outline = Rectangle(2.0 * x, max(aside + _REACH * H, (_DEEP + _FREE) * H))
        contacts = [Contact(x, aside, self.indenter.rims[1])]
        body = stack_mesh(outline, self.stack, self.mechanics, self.support, contacts, _FINENESS)
        found = rising_corrections(body, x, aside, self.indenter, self.dents)
        middle = np.array([x, self.middle, 0.0])
        ends = (_REACH * H, _DEEP * H - self.middle)
        fields = [
            SplineField.of(_faded(each, middle, ends, H), self.nodes, height, _DEGREE)
            for each in found
        ]
        return np.array([f.coefficients for f in fields]), np.array([c.sunk[0] for c in found])


def _cells(end: float) -> Array:
    """Nodes from 0 to an end, over the thickness of the stack."""
    even = np.arange(0.0, _EVEN + 0.5 * _CELL, _CELL)
    wide = math.ceil((end - even[-1]) / _WIDE)
    return np.append(even, np.linspace(even[-1], end, wide + 1)[1:])


def _faded(
    correction: Correction, middle: Array, ends: tuple[float, float], H: float
) -> Callable[[Array], Array]:
    """Correction from the middle of the fields, faded out along the side and into the gel."""

    def field(points: Array) -> Array:
        values = correction.in_gel(points + middle)
        for distance, end in ((np.abs(points[..., 0]), ends[0]), (points[..., 1], ends[1])):
            t = np.clip((end - distance) / (_FADE * H), 0.0, 1.0)
            values *= (t * t * (3.0 - 2.0 * t))[..., None]
        return values

    return field
