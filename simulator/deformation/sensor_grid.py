"""Solved sensors about a nominal one, and the weights by which others are interpolated.

Sensors of one design differ a little in thickness, moduli and clamp. They share the solutions of
sensors on a grid: of steps in thickness and moduli for presses, in span, offset, thickness and
modulus for bends.
"""

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, cast

from eitskin.config import MAX_TOML, from_dict, toml_table
from eitskin.errors import ConfigurationError
from eitskin.extras import old_names
from eitskin.files import read_text
from eitskin.geometry.deformation.fixtures import Clamp, Fixture
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.mechanics.layer_stack import Mechanics, Stack

Steps = tuple[int, ...]

# Stacks are solved for moduli of the encapsulation over the gel's of 1.4 2^(k/2), k an integer;
# 1.4 is the reference. Likewise for a substrate, of 2^(k/2).
REFERENCE_RATIO, SUBSTRATE_RATIO = 1.4, 1.0
_THICKER, _STIFFER = 1.1, math.sqrt(2.0)  # ratios of neighbouring thicknesses and moduli
# Steps up to which the neighbours of the reference serve: hand-made specimens stay within.
_MAX_FROM_REFERENCE = 2.6
_TOLERANCE, _NEGLIGIBLE = 1e-9, 1e-12  # of a step, and of a weight


@old_names(about="from_nominal", replaced_by="override")
@dataclass(frozen=True, slots=True)
class SensorGrid:
    """Nominal values about which sensors are solved; a sensor's own where they are None.

    Attributes:
        thickness: thickness of the gel, for touches and bends [m].
        ratio: shear modulus of the encapsulation over the gel's, for bends.
        span, offset: span and offset of the clamp [m].

    Example:
        >>> from eitskin import SensorDesign, Simulator
        >>> from eitskin.geometry import Clamp
        >>> from eitskin.simulator import SensorGrid
        >>> grid, clamp = SensorGrid(span=0.040, offset=0.008), Clamp(span=0.041)
        >>> sim = Simulator(SensorDesign.reference(), "coarse", fixture=clamp, grid=grid)
        >>> sim.protocol.n_electrodes
        8
    """

    thickness: float | None = None
    ratio: float | None = None
    span: float | None = None
    offset: float | None = None

    def __post_init__(self) -> None:
        """Check the numbers."""
        for name in ("thickness", "ratio", "span"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise ConfigurationError(f"grid {name} must be a positive number, got {value}")
        if self.offset is not None and not math.isfinite(self.offset):
            raise ConfigurationError(f"grid offset must be finite, in m, got {self.offset}")

    @classmethod
    def from_nominal(
        cls, design: SensorDesign, fixture: Fixture, mechanics: Mechanics
    ) -> "SensorGrid":
        """Grid about a nominal sensor on its fixture."""
        ratio = mechanics.encapsulation.shear_modulus / mechanics.gel.shear_modulus
        clamp = (fixture.span, fixture.offset) if isinstance(fixture, Clamp) else (None, None)
        return cls(design.thickness, ratio, *clamp)

    def override(self, other: "SensorGrid | None") -> "SensorGrid":
        """Grid with the values of another, where that has any."""
        values = dataclasses.asdict(other) if other else {}
        return dataclasses.replace(self, **{k: v for k, v in values.items() if v is not None})


OWN_GRID = SensorGrid()
"""Grid about a sensor's own values, which are solved exactly."""

# Keys by which files of version 0.2 held the grid.
_OLD_KEYS = {
    "thickness": ("mechanics", "solved_thickness"),
    "ratio": ("mechanics", "solved_ratio"),
    "span": ("fixture", "solved_span"),
    "offset": ("fixture", "solved_offset"),
}


def with_grid(document: Mapping[str, Any]) -> dict[str, Any]:
    """Document whose grid has a table of its own, `grid`.

    A file of mechanics may have it as `grid`, and files of version 0.2 have it under old keys of
    `mechanics` and `fixture`.
    """
    new_table = {
        key: dict(value)
        if key in ("mechanics", "fixture") and isinstance(value, Mapping)
        else value
        for key, value in document.items()
    }
    tables = {key: value for key, value in new_table.items() if isinstance(value, dict)}
    grid = dict(tables.get("mechanics", {}).pop("grid", {}))
    for name, (table, key) in _OLD_KEYS.items():
        if key in tables.get(table, {}):
            grid[name] = tables[table].pop(key)
            if table == "fixture":  # the old keys distinguished a clamp from a hinge
                tables[table].setdefault("faces", "both")
    return new_table | {"grid": grid} if grid and "grid" not in new_table else new_table


def read_fixed(
    fixture: Path | None, mechanics: Path | None
) -> tuple[Fixture, Mechanics, SensorGrid]:
    """Fixture and mechanics from TOML files, the default ones without, and the grid in them.

    Raises ConfigurationError for files that do not fit.
    """
    paths = {"fixture": fixture, "mechanics": mechanics, "grid": mechanics}
    fixed_tables = {
        name: toml_table(read_text(path, MAX_TOML), str(path))
        for name, path in paths.items()
        if path and name != "grid"
    }
    tables = with_grid(fixed_tables)
    made: dict[str, Any] = {"fixture": Clamp(), "mechanics": Mechanics(), "grid": OWN_GRID}
    for name, kind in (("fixture", Fixture), ("mechanics", Mechanics), ("grid", SensorGrid)):
        if name in tables:
            made[name] = from_dict(cast("type[Any]", kind), tables[name], str(paths.get(name, "")))
    return made["fixture"], made["mechanics"], made["grid"]


def lagrange_weights(position: float, nodes: range) -> list[tuple[int, float]]:
    """Lagrange weights at `position` of values at `nodes`; a single weight at a node."""
    nearest = round(position)
    if abs(position - nearest) < _TOLERANCE:
        return [(nearest, 1.0)]
    return [(p, math.prod((position - q) / (p - q) for q in nodes if q != p)) for p in nodes]


def cut_weights(positions: Sequence[float], stencils: Sequence[range]) -> dict[Steps, float]:
    """Weights of solved sensors, of which each differs from the base along one axis at most.

    The result is the base's plus one correction per axis: a high-dimensional model representation
    of first order, cut at the base (Rabitz and Alis 1999).

    Args:
        positions: positions of the wanted sensor, in steps from the base along each axis.
        stencils: numbers of the steps that serve, along each axis.
    """
    base = (0,) * len(positions)
    weights = {base: 1.0}
    for axis, (position, nodes) in enumerate(zip(positions, stencils, strict=True)):
        for step, weight in lagrange_weights(position, nodes):
            key = tuple(step * (k == axis) for k in range(len(base)))
            weights[key] = weights.get(key, 0.0) + weight
        weights[base] -= 1.0
    return {steps: weight for steps, weight in weights.items() if abs(weight) > _NEGLIGIBLE}


@dataclass(frozen=True, slots=True)
class StackGrid:
    """Solved stacks about that of a design.

    Their axes are the thickness, then the moduli of encapsulation and substrate where there are
    such, in steps of equal ratios.

    Attributes:
        stack: stack of the design.
        nominal: solved thickness over the design's.
        positions: positions of the design's stack along each axis, in steps.
    """

    stack: Stack
    nominal: float
    positions: tuple[float, ...]

    @classmethod
    def from_design(
        cls, design: SensorDesign, mechanics: Mechanics, grid: SensorGrid
    ) -> "StackGrid":
        """Grid around the stack of a design."""
        stack = mechanics.stack(design)
        moduli = [sheet.law.shear_modulus for sheet in stack.sheets]
        nominal = (grid.thickness or design.thickness) / design.thickness
        positions = [-math.log(nominal) / math.log(_THICKER)]
        for number, ratio in _sheet_moduli(stack):
            relative = moduli[number] / moduli[stack.gel] / ratio
            positions.append(math.log(relative) / math.log(_STIFFER))
        return cls(stack, nominal, tuple(positions))

    def stack_at_steps(self, steps: Steps) -> Stack:
        """Stack at a number of steps along each axis."""
        stack = _scaled_heights(self.stack, self.nominal * _THICKER ** steps[0])
        gel = stack.sheets[stack.gel].law.shear_modulus
        for (number, ratio), step in zip(_sheet_moduli(stack), steps[1:], strict=True):
            around = (number,) if number != stack.gel + 1 else (stack.gel - 1, number)
            stack = _with_modulus(stack, around, ratio * gel * _STIFFER**step)
        return stack

    def full_weights(self) -> Iterator[tuple[Stack, float]]:
        """Stacks of the tensor product of all axes, and their weights.

        The product is quadratic over the thickness and cubic over moduli.
        """
        near = round(self.positions[0]) if abs(self.positions[0]) > 1.0 else 0
        stencils = [range(near - 1, near + 2)]
        for position in self.positions[1:]:
            first = math.ceil(position) - 2
            stencils.append(range(first, first + 4))
        axes = [lagrange_weights(*each) for each in zip(self.positions, stencils, strict=True)]
        for corner in product(*axes):
            steps, weights = zip(*corner, strict=True)
            yield self.stack_at_steps(steps), math.prod(weights)

    def base_and_weights(self) -> tuple[Stack, dict[Stack, float]]:
        """Solved stack next to the design's, and cut weights of that stack and its neighbours.

        The neighbours are the next on both sides, for moduli beyond those the two next on one side.
        """
        base = tuple(0 if abs(t) < _MAX_FROM_REFERENCE else round(t) for t in self.positions)
        apart = [position - step for position, step in zip(self.positions, base, strict=True)]
        stencils = [
            range(-1, 2)
            if axis == 0 or abs(t) <= 1.0  # thickness comes first
            else (range(3) if t > 0.0 else range(-2, 1))
            for axis, t in enumerate(apart)
        ]
        weights = {
            self.stack_at_steps(tuple(n + k for n, k in zip(base, steps, strict=True))): weight
            for steps, weight in cut_weights(apart, stencils).items()
        }
        return self.stack_at_steps(base), weights


def _sheet_moduli(stack: Stack) -> list[tuple[int, float]]:
    """Numbers of the sheets of encapsulation and substrate, and their reference moduli."""
    above = [(stack.gel + 1, REFERENCE_RATIO)] if stack.gel + 1 < len(stack.sheets) else []
    return above + [(0, SUBSTRATE_RATIO)] * stack.substrate


def _scaled_heights(stack: Stack, factor: float) -> Stack:
    """Stack whose sensor is `factor` times as thick; a substrate stays as it is."""
    sheets = tuple(
        sheet
        if stack.substrate and number == 0
        else dataclasses.replace(sheet, thickness=factor * sheet.thickness)
        for number, sheet in enumerate(stack.sheets)
    )
    return dataclasses.replace(stack, sheets=sheets)


def _with_modulus(stack: Stack, numbers: tuple[int, ...], modulus: float) -> Stack:
    """Stack whose sheets `numbers` have the shear modulus `modulus` [Pa]."""
    sheets = list(stack.sheets)
    for number in numbers:
        law = dataclasses.replace(sheets[number].law, shear_modulus=modulus)
        sheets[number] = dataclasses.replace(sheets[number], law=law)
    return dataclasses.replace(stack, sheets=tuple(sheets))
