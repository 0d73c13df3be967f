"""Changes of presses by each other in the finite stack: from solved tables to fields of pairs."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.deformation import pair_tables
from eitskin.simulator.deformation.field import Field, Frame
from eitskin.simulator.deformation.node_sums import (
    BOTH_MIRRORED,
    DIRECT,
    MIRRORED_X,
    MIRRORED_Y,
    NodeSums,
    basis_values,
    sum_of,
)
from eitskin.simulator.deformation.sensor_grid import OWN_GRID, SensorGrid
from eitskin.simulator.deformation.solution_table import SolutionTable
from eitskin.simulator.deformation.tabled_corrections import (
    TabledSensor,
    load_table,
    on_even_base,
)
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.scene.indenters import Indenter

Array = NDArray[np.float64]
Numbers = NDArray[np.floating]
Indices = NDArray[np.int64]

_TOLERANCE = 1e-9  # [m]


@lru_cache(maxsize=64)
def pair_corrections(
    design: SensorDesign, mechanics: Mechanics, indenter: Indenter, grid: SensorGrid = OWN_GRID
) -> "PairCorrections":
    """Changes of pairs on the solved stack next to a design's; minutes where not stored.

    The part of the sides is of long rectangles.
    """
    sensor = TabledSensor(on_even_base(design), mechanics, indenter)
    wide, *sides = map(load_table, sensor.pairs(sensor.stacks(grid)[0]))
    return PairCorrections(design, wide, sides[0] if sides else None, mechanics.gel.shear_modulus)


@dataclass(frozen=True, slots=True, eq=False)
class PairCorrections:
    """Change of two presses by each other on one sensor.

    Attributes:
        design: design of the sensor.
        wide: table on a wide stack.
        sides: table of what the sides add; None where they are left out.
        modulus: shear modulus of the gel; that of the tables when omitted [Pa].
    """

    design: SensorDesign
    wide: SolutionTable
    sides: SolutionTable | None = None
    modulus: float | None = None

    def evaluate(
        self,
        first: Array,
        second: Array,
        scenes: Indices,
        sums: NodeSums | None,
        turns: Numbers | None = None,
    ) -> tuple[list[Field | None], Array]:
        """Changes by pairs of presses (x, y, depth), (n, 3) [m] each.

        Returns a field of each, None where the presses do not affect each other, and by how much
        deeper each of its presses sinks [m], (n,). To the sums of `scenes` goes the sides' part,
        turned as by `NodeSums.add`.
        """
        apart = np.hypot(*(second - first)[:, :2].T)
        close = np.flatnonzero(apart < self.wide.nodes("axis_distance")[-1])
        fields: list[Field | None] = [None] * len(first)
        extra = np.zeros(len(first))
        if not len(close):
            return fields, extra
        angle = np.arctan2(*(second - first)[close, 1::-1].T)
        middle, deep = 0.5 * (first + second)[close, :2], (first * second)[close, 2]
        apart = apart[close]
        amounts, numbers = self.wide.evaluate(axis_distance=apart, product=deep)
        extra[close] = numbers["extra_depth"]
        wide = self.wide
        height = self.design.thickness
        stiffer = 1.0 if self.modulus is None else self.modulus / wide.size("modulus")
        scales = np.array([1.0, 1.0, height / wide.size("height"), stiffer])
        for k, number in enumerate(close.tolist()):
            nearest = max(float(apart[k]), float(wide.nodes("axis_distance")[0]))
            bases = pair_tables.pair_bases(nearest, wide.size("thickness"))
            at_x, at_y = middle[k].tolist()
            frame = Frame(at_x, at_y, math.cos(angle[k]), math.sin(angle[k]))
            fields[number] = Field(bases, height, amounts[k] * scales, frame)
        if self.sides is not None and sums is not None:
            near = np.flatnonzero(apart < self.sides.nodes("axis_distance")[-1])
            pairs = middle[near], apart[near], angle[near], deep[near]
            own = None if turns is None else turns[close[near]]
            _add_of_sides(self.sides, *pairs, scenes[close[near]], sums, own)
        return fields, extra


def _add_of_sides(
    table: SolutionTable,
    middle: Array,
    spacing: Array,
    angle: Array,
    deep: Array,
    scenes: Indices,
    sums: NodeSums,
    turns: Numbers | None,
) -> None:
    """Add what the sides of a strip add to pairs about their middles, of products of depths."""
    width = table.size("width")
    low = pair_tables.lowest_middle(table.size("least"), spacing, angle)
    place = (middle[:, 1] - low) / np.maximum(0.5 * width - low, _TOLERANCE)
    # The mirror image along x of a pair is that at the opposite angle. Turned by half a turn, a
    # pair is the same at the same distance from the other side.
    images = DIRECT, BOTH_MIRRORED, MIRRORED_X, MIRRORED_Y
    every = sum_of(table, (table,), sums.components, images)
    amounts, _ = every.amounts(
        [1.0],
        table.size("height"),
        axis_distance=spacing,
        direction=angle,
        place=np.clip(place, 0.0, 2.0),
    )
    amounts *= (deep / table.size("depth") ** 2)[:, None]
    bases = pair_tables.pair_side_bases(table.size("thickness"), width)
    along = basis_values(bases[0], sums.nodes[0], middle[:, 0])
    across = bases[1].dense(sums.nodes[1])
    sums.add(every.modes, amounts, along, across, scenes, turns=turns)
