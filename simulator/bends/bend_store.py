"""Store of solved bend tables, in the package and on disk, with interpolation between them.

A bend depends on span, offset, thickness and ratio of the moduli. About nominal values of the four,
displacements are the nominal ones plus one correction per parameter, each quadratic through solved
neighbours: a high-dimensional model representation of first order, cut at the nominal values
(Rabitz and Alis 1999). Lengths over thickness and moduli over the gel's matter, so that everything
is solved at one thickness and one modulus of the gel.
"""

import dataclasses
import logging
import math
from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.deformation.fixtures import Bend, Clamp, Fixture
from eitskin.geometry.deformation.kinematics import Deformation
from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.sensor import Plates, SensorDesign, Support
from eitskin.simulator.bends import bend_table as tables
from eitskin.simulator.bends.bend_3d import BentStack, ClampedStack, Slab, clamped_lines
from eitskin.simulator.bends.bend_table import BendTable
from eitskin.simulator.mechanics import solved_files
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.mechanics.processes import processes

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]

log = logging.getLogger(__name__)

SHIPPED = Path(__file__).with_name("library")

# Version of the tables: raise it whenever bends are solved or tabulated in another way.
_VERSION = 2
# Everything is solved for a stack this thick [m], whose gel has this shear modulus [Pa].
_THICKNESS, _MODULUS = 0.012, 20e3
# Distances of solved neighbours: of the span, relative; of the offset, over the thickness of the
# stack; of the thickness, relative; of the ratio of the moduli, as a factor.
_STEPS = {"span": 0.04, "offset": 0.08, "thickness": 0.06, "ratio": 1.4}
_REACH = 1.5  # steps from the nominal value within which its two neighbours serve
_COMPRESSION = 5e-6  # largest error of stored displacements over the thickness of the stack
_LENGTHS = ("x", "y", "z", "values", "thickness", "centre")


@dataclasses.dataclass(frozen=True, slots=True)
class _Case:
    """One stack to be solved.

    Attributes:
        slab: the layer.
        clamp: span, offset, compliance and held faces.
        mechanics: materials.
        lines: grid lines of the quarter [m].
    """

    slab: Slab
    clamp: Clamp
    mechanics: Mechanics
    lines: tuple[tuple[float, ...], ...]

    @property
    def scales(self) -> tuple[float, float]:
        """Thickness and modulus relative to the solved ones."""
        modulus = self.mechanics.gel.shear_modulus / _MODULUS
        return self.slab.encapsulated_thickness / _THICKNESS, modulus

    def scaled(self) -> "_Case":
        """Equal case of the solved thickness and modulus."""
        length, modulus = self.scales
        outline = self.slab.outline
        slab = Slab(
            Rectangle(outline.length / length, outline.width / length),
            self.slab.thickness / length,
            self.slab.encapsulated_thickness / length,
        )
        clamp = Clamp(
            self.clamp.span / length,
            self.clamp.offset / length,
            self.clamp.compliance * modulus / length,
            self.clamp.faces,
        )
        old = self.mechanics
        mechanics = Mechanics(
            dataclasses.replace(old.gel, shear_modulus=old.gel.shear_modulus / modulus),
            dataclasses.replace(
                old.encapsulation, shear_modulus=old.encapsulation.shear_modulus / modulus
            ),
            old.margin / length,
            old.bulk_ratio,
        )
        lines = tuple(tuple(x / length for x in line) for line in self.lines)
        return _Case(slab, clamp, mechanics, lines)

    @property
    def name(self) -> str:
        """Name of the file of the table: a hash of everything that the scaled table depends on."""
        case = self.scaled()
        laws = (case.mechanics.gel, case.mechanics.encapsulation)
        described = {
            "version": _VERSION,
            "sizes": [*(2.0 * case.slab.half_sizes), case.slab.encapsulated_thickness],
            "clamp": [case.clamp.span, case.clamp.offset, case.clamp.compliance, case.clamp.faces],
            "laws": [[type(law).__name__, *dataclasses.astuple(law)] for law in laws],
            "margin": case.mechanics.margin,
            "bulk_ratio": case.mechanics.bulk_ratio,
            "lines": case.lines,
            "angles_deg": tables.ANGLES_DEG,
        }
        return solved_files.file_name("bend", described)


def bend(design: SensorDesign, fixture: Fixture, mechanics: Mechanics, angle: Bend) -> Deformation:
    """Deformation of a sensor by its fixture.

    The first bend of a clamped sensor that has not been solved takes half a minute.

    Raises:
        ConfigurationError: for a bend out of reach, or a clamped sensor that is not a rectangle.
        SolidError: where even small bends of the clamped sensor have no stable equilibrium.
    """
    if isinstance(fixture, Clamp):
        return bend_table(design, fixture, mechanics).at(angle.angle_deg)
    return fixture.flexure(design, angle)


@lru_cache(maxsize=8)
def equilibrium(design: SensorDesign, clamp: Clamp, mechanics: Mechanics, angle: Bend) -> BentStack:
    """Equilibrium of a whole clamped stack at one angle, the state in which it is pressed.

    Each takes some seconds and is not stored. Raises SolidError where there is none.
    """
    held = on_support(clamp, design.support)
    return next(ClampedStack(design, held, mechanics).equilibria([angle.angle_deg]))


@lru_cache(maxsize=64)
def check_clamp(design: SensorDesign, clamp: Clamp, mechanics: Mechanics) -> None:
    """Raise ConfigurationError for a sensor that cannot be clamped."""
    clamped_lines(Slab.of(design), clamp, mechanics)


@lru_cache(maxsize=16)
def bend_table(design: SensorDesign, clamp: Clamp, mechanics: Mechanics) -> BendTable:
    """Bend table of a clamped sensor; the first time takes half a minute."""
    found = [(_stored(case), weight) for case, weight in _needed(design, clamp, mechanics)]
    if len(found) == 1:
        return found[0][0]
    return tables.weighted_sum(
        [table for table, _ in found], np.array([weight for _, weight in found])
    )


def missing(design: SensorDesign, clamp: Clamp, mechanics: Mechanics) -> set[Path]:
    """Absent files of tables that `bend_table` needs; each takes half a minute to solve."""
    return {solved_files.folder() / case.name for case in _absent(design, clamp, mechanics)}


def prepare(
    clamped: Iterable[tuple[SensorDesign, Clamp, Mechanics]],
    progress: Progress | None = None,
    workers: int = 1,
) -> None:
    """Solve the tables of clamped sensors that are neither shipped nor on the disk.

    Args:
        clamped: arguments of `bend_table`.
        progress: called with the number of solved bends and of all bends.
        workers: number of processes, each with a table.
    """
    cases = list({case.name: case for each in clamped for case in _absent(*each)}.values())
    each, workers = len(tables.ANGLES_DEG), max(min(workers, len(cases)), 1)

    def report(before: int, done: int, _: int = 0) -> None:
        if progress:
            progress(before * each + done, each * len(cases))

    if workers == 1:
        for number, case in enumerate(cases):
            _kept(case, partial(report, number))
        return
    with processes(workers) as run:
        for number, _ in enumerate(run(_kept, cases), 1):
            report(number, 0)


def on_support(clamp: Clamp, support: Support) -> Clamp:
    """Clamp of a supported sensor: plates that support the sensor hold its bottom face only."""
    return dataclasses.replace(clamp, faces="bottom") if isinstance(support, Plates) else clamp


def _absent(design: SensorDesign, clamp: Clamp, mechanics: Mechanics) -> Iterator[_Case]:
    for case, _ in _needed(design, clamp, mechanics):
        if not any((place / case.name).is_file() for place in (SHIPPED, solved_files.folder())):
            yield case


def _needed(design: SensorDesign, clamp: Clamp, mechanics: Mechanics) -> list[tuple[_Case, float]]:
    """Solved stacks, and their weights in the table of a design."""
    clamp = on_support(clamp, design.support)
    slab = Slab.of(design)
    ratio = mechanics.encapsulation.shear_modulus / mechanics.gel.shear_modulus
    wanted = {
        "span": clamp.span,
        "offset": clamp.offset,
        "thickness": slab.thickness,
        "ratio": ratio,
    }
    nominal = {
        "span": clamp.solved_span or clamp.span,
        "offset": clamp.offset if clamp.solved_offset is None else clamp.solved_offset,
        "thickness": mechanics.solved_thickness or slab.thickness,
        "ratio": mechanics.solved_ratio or ratio,
    }
    stack = slab.encapsulated_thickness * nominal["thickness"] / slab.thickness
    weights: dict[tuple[tuple[str, int], ...], float] = {(): 1.0}
    for name, value in wanted.items():
        for step, weight in _lagrange(_position(name, value, nominal[name], stack)):
            key = ((name, step),) if step else ()
            weights[key] = weights.get(key, 0.0) + weight
        weights[()] -= 1.0
    cases = ((dict(key), weight) for key, weight in weights.items() if abs(weight) > 1e-12)
    return [(_case(slab, clamp, mechanics, nominal, steps), weight) for steps, weight in cases]


def _position(name: str, value: float, nominal: float, stack: float) -> float:
    """Position of a value in steps from the nominal one."""
    if name == "ratio":
        return math.log(value / nominal) / math.log(_STEPS[name])
    return (value - nominal) / (_STEPS[name] * (stack if name == "offset" else nominal))


def _value(name: str, step: int, nominal: float, stack: float) -> float:
    """Value at a number of steps from the nominal one; see `_position`."""
    if name == "ratio":
        return float(nominal * _STEPS[name] ** step)
    return nominal + step * _STEPS[name] * (stack if name == "offset" else nominal)


def _lagrange(position: float) -> list[tuple[int, float]]:
    """Nodes and quadratic Lagrange weights at `position`; a single weight at a node."""
    nearest = round(position)
    if abs(position - nearest) < 1e-9:
        return [(nearest, 1.0)]
    middle = nearest if abs(position) > _REACH else 0  # specimens share three nodes
    nodes = range(middle - 1, middle + 2)
    return [(p, math.prod((position - q) / (p - q) for q in nodes if q != p)) for p in nodes]


def _case(
    slab: Slab, clamp: Clamp, mechanics: Mechanics, nominal: dict[str, float], steps: dict[str, int]
) -> _Case:
    """Stack a number of steps from the nominal one, on the nominal mesh, stretched."""
    around = slab.encapsulated_thickness / slab.thickness
    stack = around * nominal["thickness"]
    value = {name: _value(name, steps.get(name, 0), nominal[name], stack) for name in nominal}
    modulus = value["ratio"] * mechanics.gel.shear_modulus
    law = dataclasses.replace(mechanics.encapsulation, shear_modulus=modulus)
    made = dataclasses.replace(mechanics, encapsulation=law)

    def body(of: dict[str, float]) -> tuple[Slab, Clamp]:
        return (
            dataclasses.replace(
                slab, thickness=of["thickness"], encapsulated_thickness=around * of["thickness"]
            ),
            Clamp(of["span"], of["offset"], clamp.compliance, clamp.faces),
        )

    x, y, z = clamped_lines(*body(nominal), made)
    before, after = 0.5 * nominal["span"], 0.5 * value["span"]
    ends = [float(slab.half_sizes[0]), float(x[-1])]
    x = np.interp(x, [0.0, before, *ends], [0.0, after, *ends])
    z = z * (value["thickness"] / nominal["thickness"])
    lines = tuple(tuple(line.tolist()) for line in (x, y, z))
    return _Case(*body(value), made, lines)


def _stored(case: _Case) -> BendTable:
    """Table of a case from package or disk, or solved now and stored."""
    found = _read(SHIPPED / case.name) or _kept(case)
    length, modulus = case.scales
    scale = dict.fromkeys(_LENGTHS, length)
    scale |= dict.fromkeys(("energies", "moments"), modulus * length**3)
    arrays = tables.arrays_of(found).items()
    return BendTable(**{name: scale.get(name, 1.0) * array for name, array in arrays})


def _kept(case: _Case, progress: Progress | None = None) -> BendTable:
    path = solved_files.folder() / case.name

    def solve() -> BendTable:
        log.info("solving the bends of a clamped sensor, which takes half a minute")
        return _solve(case, progress)

    found = solved_files.kept(path, partial(_read, path), solve, partial(_write, path=path))
    return _read(path) or found  # rounded as in the file, whether solved now or before


def _solve(case: _Case, progress: Progress | None = None) -> BendTable:
    scaled = case.scaled()
    x, y, z = (np.array(line) for line in scaled.lines)
    stack = ClampedStack(scaled.slab, scaled.clamp, scaled.mechanics, lines=(x, y, z))
    return BendTable.of(stack, tables.ANGLES_DEG, progress)


def _write(table: BendTable, path: Path) -> None:
    """Store a table if the disk can be written; otherwise the table is solved again next time.

    The displacements are stored by proper orthogonal decomposition, in single precision.
    """
    arrays = tables.arrays_of(table)
    values = arrays.pop("values")
    rows = values.reshape(len(values), -1)
    left, sizes, modes = np.linalg.svd(rows, full_matrices=False)
    modes = modes.astype(np.float32)
    for rank in range(1, len(sizes) + 1):
        amounts = left[:, :rank] * sizes[:rank]
        error = np.abs(amounts @ modes[:rank].astype(float) - rows).max()
        if error < _COMPRESSION * float(table.thickness):
            break
    arrays |= {"amounts": amounts, "modes": modes[:rank].reshape(rank, *values.shape[1:])}
    solved_files.write(path, arrays)


def _read(path: Path) -> BendTable | None:
    """Table in a file; None where the file is absent or incomplete."""
    found = solved_files.read(path)
    if found is None or not {"amounts", "modes"} <= set(found):
        return None
    amounts, modes = found.pop("amounts"), found.pop("modes").astype(float)
    try:
        return BendTable(values=np.tensordot(amounts, modes, axes=1), **found)
    except (TypeError, ValueError):
        return None
