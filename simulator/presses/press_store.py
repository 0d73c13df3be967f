"""Store of solved press tables, in memory and on disk, with interpolation between them."""

import dataclasses
import math
from collections.abc import Iterable
from functools import lru_cache, partial
from itertools import repeat
from pathlib import Path

import numpy as np

from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.mechanics import solved_files
from eitskin.simulator.mechanics.layer_stack import Mechanics, Sheet, Stack
from eitskin.simulator.mechanics.processes import processes
from eitskin.simulator.presses import press_table as tables
from eitskin.simulator.presses.correction_table import Report
from eitskin.simulator.presses.press_table import PressTable
from eitskin.simulator.scene.indenters import Indenter

# Tables that come with the package.
LIBRARY = Path(__file__).with_name("library")
# Version of the tables: raise it whenever presses are solved or tabulated in another way.
_VERSION = 2
# Tables are solved for moduli of the encapsulation over the gel's of 1.4 2^(k/2), k an integer;
# 1.4 is the reference. Other ratios are interpolated. Likewise for a substrate, of 2^(k/2).
REFERENCE_RATIO = 1.4
SUBSTRATE_RATIO = 1.0
_STEPS = 2.0  # per factor of two
_THICKER = 1.1  # ratio of neighbouring solved thicknesses, where sensors share tables
# Everything is solved at one scale: a layer this thick [m], of this shear modulus [Pa].
_THICKNESS, _MODULUS = 0.005, 20e3
_SAMPLES = 65  # of the indenter's profile, which identify the indenter
_LENGTHS = ("depths", "contact_radii", "thickness", "knots", "moved")
_STRESSES = ("peak_pressures", "stressed")


@lru_cache(maxsize=16)
def press_table(design: SensorDesign, mechanics: Mechanics, indenter: Indenter) -> PressTable:
    """Press table of a sensor and an indenter; the first time takes seconds to a minute.

    Raises ConfigurationError where not even shallow presses are carried.
    """
    thickness = design.thickness
    found = [(stored(stack, indenter), weight) for stack, weight in _needed(design, mechanics)]
    if len(found) == 1:
        return found[0][0]
    return tables.weighted_sum(
        [one.stretched(thickness / float(one.thickness)) for one, _ in found],
        np.array([weight for _, weight in found]),
    )


def is_stored(design: SensorDesign, mechanics: Mechanics, indenter: Indenter) -> bool:
    """Whether all tables that `press_table` needs are on the disk."""
    return not missing(design, mechanics, indenter)


def prepare(
    sensors: Iterable[tuple[SensorDesign, Mechanics]],
    indenter: Indenter,
    report: Report | None = None,
    workers: int = 1,
) -> None:
    """Solve and store the absent tables of sensors, in a number of processes.

    `report` is called with the number of tables done and their total. Raises ConfigurationError
    where not even shallow presses are carried.
    """
    needed = {_path(stack, indenter): stack for sensor in sensors for stack, _ in _needed(*sensor)}
    absent = [stack for path, stack in needed.items() if not _is_kept(path)]
    with processes(max(min(workers, len(absent)), 1)) as run:
        for done, _ in enumerate(run(stored, absent, repeat(indenter)), 1):
            if report:
                report(done, len(absent))


def missing(design: SensorDesign, mechanics: Mechanics, indenter: Indenter) -> set[Path]:
    """Absent files of tables that `press_table` needs; each takes seconds to a minute to solve."""
    paths = (_path(stack, indenter) for stack, _ in _needed(design, mechanics))
    return {path for path in paths if not _is_kept(path)}


def _is_kept(path: Path) -> bool:
    """Whether a table comes with the package or is in the user's folder."""
    return (LIBRARY / path.name).is_file() or path.is_file()


def _needed(design: SensorDesign, mechanics: Mechanics) -> list[tuple[Stack, float]]:
    """Solved stacks, and their weights in the table of a design's stack."""
    return [
        (stack, high * stiff * soft)
        for thick, high in _of_thicknesses(mechanics.stack(design), design, mechanics)
        for cased, stiff in _of_ratios(thick)
        for stack, soft in _of_substrates(cased)
    ]


def _of_thicknesses(
    stack: Stack, design: SensorDesign, mechanics: Mechanics
) -> list[tuple[Stack, float]]:
    """Stack at solved thicknesses, and their weights."""
    solved = mechanics.solved_thickness or design.thickness
    position = float(np.log(design.thickness / solved) / np.log(_THICKER))
    middle = round(position) if abs(position) > 1.0 else 0  # within a step three tables serve all
    return [
        (scaled_heights(stack, solved * _THICKER**p / design.thickness), weight)
        for p, weight in lagrange_weights(position, range(middle - 1, middle + 2))
    ]


def _of_ratios(stack: Stack) -> list[tuple[Stack, float]]:
    """Stack with solved moduli of the encapsulation, and their weights."""
    gel, around = stack.gel, (stack.gel - 1, stack.gel + 1)
    if around[1] == len(stack.sheets):
        return [(stack, 1.0)]
    return _of_moduli(stack, around, REFERENCE_RATIO * stack.sheets[gel].law.shear_modulus)


def _of_substrates(stack: Stack) -> list[tuple[Stack, float]]:
    """Stack with solved moduli of the substrate, and their weights; the stack without one."""
    if not stack.substrate:
        return [(stack, 1.0)]
    return _of_moduli(stack, (0,), SUBSTRATE_RATIO * stack.sheets[stack.gel].law.shear_modulus)


def _of_moduli(
    stack: Stack, numbers: tuple[int, ...], reference: float
) -> list[tuple[Stack, float]]:
    """Stack with solved moduli of sheets of one modulus, steps from `reference` [Pa]; weights."""
    modulus = stack.sheets[numbers[0]].law.shear_modulus
    position = float(_STEPS * np.log2(modulus / reference))
    first = math.ceil(position) - 2
    return [
        (with_modulus(stack, numbers, reference * 2.0 ** (p / _STEPS)), weight)
        for p, weight in lagrange_weights(position, range(first, first + 4))
    ]


def lagrange_weights(position: float, nodes: range) -> list[tuple[int, float]]:
    """Lagrange weights at `position` of values at `nodes`; a single weight at a node."""
    nearest = round(position)
    if abs(position - nearest) < 1e-9:
        return [(nearest, 1.0)]
    return [(p, math.prod((position - q) / (p - q) for q in nodes if q != p)) for p in nodes]


def scaled_heights(stack: Stack, factor: float) -> Stack:
    """Stack whose sensor is `factor` times as thick; a substrate stays as it is."""
    sheets = tuple(
        sheet
        if stack.substrate and number == 0
        else dataclasses.replace(sheet, thickness=factor * sheet.thickness)
        for number, sheet in enumerate(stack.sheets)
    )
    return dataclasses.replace(stack, sheets=sheets)


def with_modulus(stack: Stack, numbers: tuple[int, ...], modulus: float) -> Stack:
    """Stack whose sheets `numbers` have the shear modulus `modulus` [Pa]."""
    sheets = list(stack.sheets)
    for number in numbers:
        law = dataclasses.replace(sheets[number].law, shear_modulus=modulus)
        sheets[number] = dataclasses.replace(sheets[number], law=law)
    return dataclasses.replace(stack, sheets=tuple(sheets))


def stored(stack: Stack, indenter: Indenter) -> PressTable:
    """Table of the conductive layer from the disk, or solved now and stored."""
    length, modulus = _scales(stack)
    path = _path(stack, indenter)

    def solve() -> PressTable:
        scaled = _scaled_stack(stack, length, modulus)
        return tables.solve_table(scaled, stack.gel, _ScaledIndenter(indenter, length))

    found = _read(LIBRARY / path.name) or solved_files.kept(
        path, partial(_read, path), solve, lambda table: solved_files.write(path, _arrays(table))
    )
    scale = dict.fromkeys(_LENGTHS, length) | dict.fromkeys(_STRESSES, modulus)
    scale |= {"forces": modulus * length**2, "energies": modulus * length**3}
    values = {name: scale.get(name, 1.0) * array for name, array in _arrays(found).items()}
    return PressTable(**values)


def _scales(stack: Stack) -> tuple[float, float]:
    """Thickness and modulus of the conductive layer relative to the solved ones."""
    layer = stack.sheets[stack.gel]
    return layer.thickness / _THICKNESS, layer.law.shear_modulus / _MODULUS


def _path(stack: Stack, indenter: Indenter) -> Path:
    return solved_files.folder() / _name(stack, indenter, *_scales(stack))


def _scaled_stack(stack: Stack, length: float, modulus: float) -> Stack:
    sheets = tuple(
        Sheet(
            sheet.thickness / length,
            dataclasses.replace(sheet.law, shear_modulus=sheet.law.shear_modulus / modulus),
        )
        for sheet in stack.sheets
    )
    return dataclasses.replace(stack, sheets=sheets)


@dataclasses.dataclass(frozen=True, slots=True)
class _ScaledIndenter:
    """Scaled indenter: all lengths are divided by `length`."""

    indenter: Indenter
    length: float

    @property
    def rough(self) -> bool:
        return self.indenter.rough

    @property
    def rims(self) -> tuple[float, float]:
        inner, outer = self.indenter.rims
        return inner / self.length, outer / self.length

    def profile(self, r: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        height, slope, bend = self.indenter.profile(r * self.length)
        return height / self.length, slope, bend * self.length


def _name(stack: Stack, indenter: Indenter, length: float, modulus: float) -> str:
    """Name of the file of a scaled table."""
    scaled = _scaled_stack(stack, length, modulus)
    described = {
        "version": _VERSION,
        "sheets": [
            [sheet.thickness, type(sheet.law).__name__, *dataclasses.astuple(sheet.law)]
            for sheet in scaled.sheets
        ],
        "bulk_ratio": stack.bulk_ratio,
        **indenter_samples(_ScaledIndenter(indenter, length)),
    }
    return solved_files.file_name("kernel", described)


def _arrays(table: PressTable) -> dict[str, np.ndarray]:
    return {field.name: getattr(table, field.name) for field in dataclasses.fields(PressTable)}


def _read(path: Path) -> PressTable | None:
    """Table in a file; None where the file is absent or incomplete."""
    found = solved_files.read(path)
    names = {field.name for field in dataclasses.fields(PressTable)}
    return PressTable(**found) if found is not None and set(found) == names else None


def indenter_samples(indenter: Indenter) -> dict[str, object]:
    """Numbers that identify an indenter."""
    heights, slopes, _ = indenter.profile(np.linspace(0.0, indenter.rims[1], _SAMPLES))
    return {
        "rims": indenter.rims,
        "rough": indenter.rough,
        "heights": heights.tolist(),
        "slopes": slopes.tolist(),
    }
