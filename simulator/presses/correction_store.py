"""Store of correction tables, shipped and on the disk, with interpolation between stacks."""

import dataclasses
import math
import os
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import Disc, Rectangle
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.support import Rigid, Substrate
from eitskin.simulator.mechanics import solved_files
from eitskin.simulator.mechanics.layer_stack import Mechanics, Stack
from eitskin.simulator.presses.correction_table import (
    CorrectionTable,
    Report,
    StripTable,
    solve_corrections,
    solve_strip,
)
from eitskin.simulator.presses.corrections import Corrections, DiscCorrections
from eitskin.simulator.presses.disc_table import DiscTable, in_series, solve_disc
from eitskin.simulator.presses.pair_table import PairTable, solve_pairs
from eitskin.simulator.presses.press_store import (
    LIBRARY,
    REFERENCE_RATIO,
    SUBSTRATE_RATIO,
    indenter_samples,
    lagrange_weights,
    scaled_heights,
    with_modulus,
)
from eitskin.simulator.scene.indenters import Indenter
from eitskin.simulator.scene.touch import AnyIndenter

Array = NDArray[np.float64]

# Versions of the tables: raise them whenever corrections are solved or tabulated in another way.
_VERSIONS = {"corrections": 2, "strips": 2, "fine-strips": 2, "pairs": 3, "discs": 1}
# Over the thickness of the stack: length of a rectangle, so that its ends do not feel each other,
# and radius of a disc, so that there are several distances from the rim.
_SHORTEST, _SMALLEST = 8.0, 1.0
# Steps of thickness and of the modulus ratio between solved stacks, as for the tables of presses.
_THICKER, _STIFFER = 1.1, math.sqrt(2.0)
# Steps up to which the neighbours of the reference serve: hand-made specimens stay within.
_FAR = 2.6
_KEPT = 3e-4  # singular values, relative to the largest, that a stored table keeps
_OF_FIELD = 4  # dimensions of the coefficients of one field
_WORKERS = os.cpu_count() or 1
_PARTS = ("_scales", "_amplitudes", "_modes", "_shape")

Shape = TypeVar("Shape", Rectangle, Disc)


def tabulable(design: SensorDesign) -> bool:
    """Whether corrections on a design can be tabulated: on discs, and on long rectangles.

    Corrections on a rectangle must not depend on x off its ends, those on a disc on the azimuth.
    """
    outline, thickness = design.outline, design.encapsulated_thickness
    if not isinstance(design.support, Rigid | Substrate):
        return False
    if isinstance(outline, Disc):
        return outline.radius >= _SMALLEST * thickness
    return isinstance(outline, Rectangle) and outline.length >= _SHORTEST * thickness


def is_shipped(design: SensorDesign, mechanics: Mechanics, indenter: AnyIndenter) -> bool:
    """Whether all tables that a design needs come with the package."""
    return tabulable(design) and all(
        (LIBRARY / name).is_file() for name in _names(design, mechanics, indenter)
    )


def missing(design: SensorDesign, mechanics: Mechanics, indenter: AnyIndenter) -> set[Path]:
    """Absent files of tables that `corrections` needs; each takes minutes to solve."""
    if not tabulable(design):
        return set()
    names = _names(design, mechanics, indenter)
    return {solved_files.folder() / name for name in names if _file(name) is None}


@lru_cache(maxsize=64)
def _names(design: SensorDesign, mechanics: Mechanics, indenter: Indenter) -> tuple[str, ...]:
    """Names of all files that a design needs."""
    if isinstance(design.outline, Disc):
        _, weights = _of_disc(design, mechanics)
        return tuple(_name(design, stack, mechanics, indenter) for stack in weights)
    base, strips = _needed(design, mechanics)
    return (
        _name(design, base, mechanics, indenter),
        *(_strip_name(design, strip, mechanics, indenter) for strip, _ in strips),
        _pair_name(design, base, mechanics, indenter),
    )


def prepare(
    design: SensorDesign, mechanics: Mechanics, indenter: AnyIndenter, report: Report | None = None
) -> None:
    """Solve and store the absent tables of a design that is `tabulable`.

    `report` is called with the numbers of solved positions and of all that take long.
    """
    if isinstance(design.outline, Disc):
        _, weights = _of_disc(design, mechanics)
        names = {stack: _name(design, stack, mechanics, indenter) for stack in weights}
        stacks = [stack for stack in weights if _file(names[stack]) is None]
        for number, stack in enumerate(stacks):
            own = in_series(report, number, len(stacks))
            _disc(design, stack, mechanics, indenter, own)
        return
    base, _ = _needed(design, mechanics)
    if _file(_name(design, base, mechanics, indenter)) is None:
        _stored(design, base, mechanics, indenter, report)
    corrections(design, mechanics, indenter)
    pair_table(design, mechanics, indenter)


@lru_cache(maxsize=64)
def corrections(
    design: SensorDesign, mechanics: Mechanics, indenter: Indenter
) -> Corrections | DiscCorrections:
    """Corrections on a design that is `tabulable`; those not stored take minutes to solve."""
    if isinstance(design.outline, Disc):
        base, weights = _of_disc(design, mechanics)
        tables = {stack: _disc(design, stack, mechanics, indenter) for stack in weights}
        weighted = tuple(zip(tables.values(), weights.values(), strict=True))
        return DiscCorrections(design.thickness, tables[base], weighted)
    base, strips = _needed(design, mechanics)
    return Corrections(
        design.thickness,
        _stored(design, base, mechanics, indenter),
        tuple((_strip(design, strip, mechanics, indenter), weight) for strip, weight in strips),
    )


@dataclasses.dataclass(frozen=True, slots=True)
class _Strip:
    """Strip of a solved stack, and whether its mesh is good for differences of two steps."""

    stack: Stack
    fine: bool


def _needed(design: SensorDesign, mechanics: Mechanics) -> tuple[Stack, list[tuple[_Strip, float]]]:
    """Solved stack next to a design's, and strips of that stack and its neighbours with weights.

    Thickness and moduli are varied one at a time, quadratically, about the solved stack (cut-HDMR,
    Rabitz and Alis 1999): the correction is that of the solved stack plus weighted differences of
    neighbours to it, for which presses on a strip and a coarse mesh suffice. The neighbours are the
    next on both sides, for moduli beyond those the two next on one side, the farther on a finer
    mesh.
    """
    stack = mechanics.stack(design)
    exact = _positions(stack, design, mechanics)
    nearest = tuple(0 if abs(t) < _FAR else round(t) for t in exact)
    base = _solved(stack, design, mechanics, nearest)
    weights: dict[_Strip, float] = {}
    for axis, position in enumerate(exact):
        t = position - nearest[axis]
        near = axis == 0 or abs(t) <= 1.0  # thickness comes first
        beside = range(-1, 2) if near else range(3) if t > 0.0 else range(-2, 1)
        for step, weight in lagrange_weights(t, beside):
            if step:
                steps = tuple(n + step * (k == axis) for k, n in enumerate(nearest))
                fine = abs(step) > 1
                weights[_Strip(_solved(stack, design, mechanics, steps), fine)] = weight
                own = _Strip(base, fine)
                weights[own] = weights.get(own, 0.0) - weight
    return base, list(weights.items())


def _of_disc(design: SensorDesign, mechanics: Mechanics) -> tuple[Stack, dict[Stack, float]]:
    """Solved stack next to a disc's, and weights of that stack and its neighbours, of sum 1."""
    base, strips = _needed(design, mechanics)
    weights = {base: 1.0}
    for strip, weight in strips:
        weights[strip.stack] = weights.get(strip.stack, 0.0) + weight
    return base, weights


def _positions(stack: Stack, design: SensorDesign, mechanics: Mechanics) -> tuple[float, ...]:
    """Thickness, and moduli of encapsulation and substrate, in steps from solved ones."""
    moduli = [sheet.law.shear_modulus for sheet in stack.sheets]
    gel = moduli[stack.gel]
    solved = mechanics.solved_thickness or design.thickness
    found = [math.log(design.thickness / solved) / math.log(_THICKER)]
    if stack.gel + 1 < len(moduli):
        found.append(math.log(moduli[-1] / gel / REFERENCE_RATIO) / math.log(_STIFFER))
    if stack.substrate:
        found.append(math.log(moduli[0] / gel / SUBSTRATE_RATIO) / math.log(_STIFFER))
    return tuple(found)


def _solved(
    stack: Stack, design: SensorDesign, mechanics: Mechanics, steps: tuple[int, ...]
) -> Stack:
    """Stack at a number of steps from the reference along each axis of `_positions`."""
    thickness = (mechanics.solved_thickness or design.thickness) * _THICKER ** steps[0]
    stack = scaled_heights(stack, thickness / design.thickness)
    rest, gel = list(steps[1:]), stack.sheets[stack.gel].law.shear_modulus
    if stack.gel + 1 < len(stack.sheets):
        around = (stack.gel - 1, stack.gel + 1)
        stack = with_modulus(stack, around, REFERENCE_RATIO * gel * _STIFFER ** rest.pop(0))
    if stack.substrate:
        stack = with_modulus(stack, (0,), SUBSTRATE_RATIO * gel * _STIFFER ** rest.pop(0))
    return stack


def _stored(
    design: SensorDesign,
    stack: Stack,
    mechanics: Mechanics,
    indenter: Indenter,
    report: Report | None = None,
) -> CorrectionTable:
    def solve() -> CorrectionTable:
        outline, around = _outline(design, Rectangle), _around(stack, mechanics)
        return solve_corrections(outline, stack, around, design.support, indenter, report, _WORKERS)

    return _kept(CorrectionTable, _name(design, stack, mechanics, indenter), solve)


def _disc(
    design: SensorDesign,
    stack: Stack,
    mechanics: Mechanics,
    indenter: Indenter,
    report: Report | None = None,
) -> DiscTable:
    def solve() -> DiscTable:
        outline, around = _outline(design, Disc), _around(stack, mechanics)
        return solve_disc(outline, stack, around, design.support, indenter, report, _WORKERS)

    return _kept(DiscTable, _name(design, stack, mechanics, indenter), solve)


@lru_cache(maxsize=64)
def pair_table(design: SensorDesign, mechanics: Mechanics, indenter: Indenter) -> PairTable:
    """Pairs of presses on the solved stack nearest to a design's; minutes where not stored."""
    stack, _ = _needed(design, mechanics)

    def solve() -> PairTable:
        width, around = _outline(design, Rectangle).width, _around(stack, mechanics)
        return solve_pairs(width, stack, around, indenter, _WORKERS)

    return _kept(PairTable, _pair_name(design, stack, mechanics, indenter), solve)


def _strip(
    design: SensorDesign, strip: _Strip, mechanics: Mechanics, indenter: Indenter
) -> StripTable:
    def solve() -> StripTable:
        outline, around = _outline(design, Rectangle), _around(strip.stack, mechanics)
        support, fine = design.support, strip.fine
        return solve_strip(outline, strip.stack, around, support, indenter, _WORKERS, fine)

    return _kept(StripTable, _strip_name(design, strip, mechanics, indenter), solve)


def _around(stack: Stack, mechanics: Mechanics) -> Mechanics:
    """Materials whose encapsulation is that of a solved stack."""
    if stack.gel + 1 == len(stack.sheets):
        return mechanics
    return dataclasses.replace(mechanics, encapsulation=stack.sheets[-1].law)


def _outline(design: SensorDesign, kind: type[Shape]) -> Shape:
    if isinstance(design.outline, kind):
        return design.outline
    found, wanted = type(design.outline).__name__.lower(), kind.__name__.lower()
    raise ConfigurationError(f"table of a {wanted}, got a {found}; use touch_model='solved'")


def _file(name: str) -> Path | None:
    return next(
        (place / name for place in (LIBRARY, solved_files.folder()) if (place / name).is_file()),
        None,
    )


def _name(design: SensorDesign, stack: Stack, mechanics: Mechanics, indenter: Indenter) -> str:
    """Name of the file of a table of corrections on a rectangle or a disc."""
    if isinstance(design.outline, Disc):
        disc: dict[str, object] = {"radius": design.outline.radius, "margin": mechanics.margin}
        return _file_name("discs", stack, mechanics, indenter, disc)
    outline = _outline(design, Rectangle)
    size: dict[str, object] = {
        "outline": [outline.length, outline.width],
        "margin": mechanics.margin,
    }
    return _file_name("corrections", stack, mechanics, indenter, size)


def _strip_name(
    design: SensorDesign, strip: _Strip, mechanics: Mechanics, indenter: Indenter
) -> str:
    """Name of the file of a table of presses on a strip."""
    kind = "fine-strips" if strip.fine else "strips"
    return _file_name(kind, strip.stack, mechanics, indenter, _across(design, mechanics))


def _pair_name(design: SensorDesign, stack: Stack, mechanics: Mechanics, indenter: Indenter) -> str:
    """Name of the file of a table of pairs."""
    return _file_name("pairs", stack, mechanics, indenter, _across(design, mechanics))


def _across(design: SensorDesign, mechanics: Mechanics) -> dict[str, object]:
    return {"width": _outline(design, Rectangle).width, "margin": mechanics.margin}


def _file_name(
    kind: str,
    stack: Stack,
    mechanics: Mechanics,
    indenter: Indenter,
    size: dict[str, object],
) -> str:
    """Name of the file of a table, by everything that it depends on."""
    gel, laws = stack.sheets[stack.gel].law.shear_modulus, [sheet.law for sheet in stack.sheets]
    laws += [] if stack.gel + 1 < len(laws) else [mechanics.encapsulation]
    described = {
        "version": _VERSIONS[kind],
        **size,
        "heights": [sheet.thickness for sheet in stack.sheets],
        "laws": [
            [type(law).__name__, law.shear_modulus / gel, getattr(law, "alpha", 2.0)]
            for law in laws
        ],
        "bulk_ratio": stack.bulk_ratio,
        "substrate": stack.substrate,
        "indenter": indenter_samples(indenter),
    }
    return solved_files.file_name(kind, described)


def _arrays(table: StripTable | PairTable | DiscTable) -> Iterator[tuple[str, Array]]:
    """Arrays of a file: fields as amplitudes and modes (proper orthogonal decomposition)."""
    for field in dataclasses.fields(table):
        array = getattr(table, field.name)
        if array.ndim <= _OF_FIELD:
            yield field.name, array
            continue
        scales = np.sqrt(np.mean(array**2, axis=tuple(range(array.ndim - 1))))
        flat = (array / scales).reshape(-1, np.prod(array.shape[-_OF_FIELD:]))
        left, singular, modes = np.linalg.svd(flat, full_matrices=False)
        rank = max(1, int(np.count_nonzero(singular > _KEPT * singular[0])))
        yield f"{field.name}_scales", scales
        yield f"{field.name}_shape", np.array(array.shape)
        yield f"{field.name}_amplitudes", (left[:, :rank] * singular[:rank]).astype(np.float32)
        yield f"{field.name}_modes", modes[:rank].astype(np.float32)


Table = TypeVar("Table", CorrectionTable, StripTable, PairTable, DiscTable)


def _read(kind: type[Table], name: str) -> Table | None:
    """Table in a file; None where there is none or it is incomplete."""
    path = _file(name)
    values = None if path is None else _loaded(path, path.stat().st_mtime_ns)
    names = {field.name for field in dataclasses.fields(kind)}
    return kind(**values) if values is not None and names == set(values) else None


def _kept(kind: type[Table], name: str, solve: Callable[[], Table]) -> Table:
    """Table from package or disk, or solved now and stored."""
    path = solved_files.folder() / name
    return solved_files.kept(
        path,
        lambda: _read(kind, name),
        solve,
        lambda table: solved_files.write(path, dict(_arrays(table))),
    )


# Specimens of one design share tables, and most scenes follow others of the same.
@lru_cache(maxsize=16)
def _loaded(path: Path, changed: int) -> dict[str, Array] | None:  # noqa: ARG001
    """Arrays of a table in a file, read again where the file has changed."""
    found = solved_files.read(path)
    if found is None:
        return None
    values = {name: array for name, array in found.items() if not name.endswith(_PARTS)}
    try:
        for shape in (name for name in found if name.endswith("_shape")):
            name = shape.removesuffix("_shape")
            scales, amplitudes, modes = (found[f"{name}{part}"] for part in _PARTS[:3])
            flat = (amplitudes @ modes).reshape(found[shape].tolist())
            values[name] = flat * scales.astype(np.float32)
    except (KeyError, ValueError):
        return None
    return values
