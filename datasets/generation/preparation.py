"""Tables of presses and bends that a recipe needs, solved before the workers start."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from eitskin.datasets.recipe.frame_sampling import specimen
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.recipe.specimen import Specimen, free_length
from eitskin.geometry.deformation.fixtures import Clamp, FreeArc
from eitskin.geometry.design.sensor import SensorDesign, Support
from eitskin.simulator.bends.bend_table import bend_problems, bend_table
from eitskin.simulator.deformation.corrections import (
    correction_problems,
    corrections,
    is_tabulable,
)
from eitskin.simulator.deformation.press_table import press_problems, press_table
from eitskin.simulator.deformation.sensor_grid import SensorGrid
from eitskin.simulator.deformation.solution_store import missing
from eitskin.simulator.deformation.solution_store import prepare as solve_missing
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.scene.indenters import Cylinder
from eitskin.simulator.scene.scene import AnyIndenter

Progress = Callable[[int, int], None]

_ALL = 48  # specimens up to which none is left out
_LEVELS = 6  # values of each property for which a specimen is taken


def missing_bend_tables(recipe: Recipe, specimens: Sequence[int] | None = None) -> set[Path]:
    """Paths of the bend tables that `prepare` would solve."""
    clamped = _clamped(recipe, specimens)
    return {path for bent in clamped for path in missing(bend_problems(*bent))}


def missing_press_tables(recipe: Recipe, specimens: Sequence[int] | None = None) -> set[Path]:
    """Paths of the press tables that `prepare` would solve."""
    pairs, found = _touches_together(recipe), set[Path]()
    for indenter in _indenters(recipe):
        for sensor in _pressed(recipe, indenter, specimens):
            problems = (*press_problems(*sensor), *correction_problems(*sensor, pairs))
            found |= missing(problems).keys()
    return found


def solved_frames(recipe: Recipe) -> int:
    """Largest number of frames whose touches are solved in 3D, as no tables are made for them."""

    def is_solved(support: Support | None) -> bool:
        sensor = recipe.sensor
        return not is_tabulable(dataclasses.replace(sensor, support=support or sensor.support))

    touched = [group for group in recipe.scenes if group.state == "touch"]
    frames = sum(group.frames for group in touched if is_solved(group.support))
    episodes = [each for each in recipe.episodes if each.largest_force]
    if is_solved(None):
        frames += sum(each.count * each.frames for each in episodes)
    return frames


def prepare(
    recipe: Recipe,
    progress: Progress | None = None,
    workers: int = 1,
    specimens: Sequence[int] | None = None,
) -> None:
    """Solve the tables that specimens share, and check the recipe's forces and bends on them.

    Args:
        recipe: of the dataset.
        progress: called with the numbers of solved bends or presses and of all in the tables that
            are being solved.
        workers: number of processes.
        specimens: their numbers; `deciding_specimens` when omitted. Others find their tables
            solved; one that needs another table solves it when it is simulated.

    Raises ConfigurationError for forces or bends out of reach on one of the specimens.
    """
    specimens = deciding_specimens(recipe) if specimens is None else specimens
    clamped = list(_clamped(recipe, specimens))
    for some in (clamped[:1], clamped[1:]):  # bends out of reach are told after the first table
        solve_missing((each for bent in some for each in bend_problems(*bent)), progress, workers)
        for bent in some:
            for angle in recipe.extreme_angles:
                bend_table(*bent).check(angle)
    pairs = _touches_together(recipe)
    for indenter, force in _indenters(recipe).items():
        sensors = list(_pressed(recipe, indenter, specimens))
        problems = [each for sensor in sensors for each in press_problems(*sensor)]
        solve_missing(problems, progress, workers)
        for sensor in sensors:
            deepest = press_table(*sensor).at_force(force).depth
            if is_tabulable(sensor[0]):
                solve_missing(correction_problems(*sensor, pairs), progress, workers)
                corrections(*sensor).check_depth(deepest)


def _indenters(recipe: Recipe) -> dict[AnyIndenter, float]:
    """Indenters that press, each with the largest force of its touches [N]."""
    found: dict[AnyIndenter, float] = {}
    groups = [
        (group.pressed_by, group.force[1]) for group in recipe.scenes if group.state == "touch"
    ]
    episodes = [(Cylinder(), each.largest_force) for each in recipe.episodes if each.largest_force]
    for indenter, force in (*groups, *episodes):
        found[indenter] = max(force, found.get(indenter, 0.0))
    return found


def _touches_together(recipe: Recipe) -> bool:
    """Whether any frame may show several touches at once."""
    groups = any(max(group.touches) > 1 for group in recipe.scenes if group.state == "touch")
    return groups or bool(recipe.episodes)


@lru_cache(maxsize=4)
def deciding_specimens(recipe: Recipe) -> tuple[int, ...]:
    """Numbers of the specimens that decide which tables are needed, and what is within reach.

    Few specimens all decide. Among many, those do that are nearest to evenly spaced values, from
    the least to the largest, of a property on which tables depend: the time spent on tables does
    not grow with the number of specimens of one mount.
    """
    count = recipe.specimens.count
    if count <= _ALL:
        return tuple(range(count))
    properties = np.array([_properties(specimen(recipe, number)) for number in range(count)])
    chosen = set(range(min(recipe.mounts.count, count)))  # every mount has tables of its own
    for values in properties.T:
        levels = np.linspace(values.min(), values.max(), _LEVELS)
        chosen.update(int(np.abs(values - level).argmin()) for level in levels)
    return tuple(sorted(chosen))


def _properties(made: Specimen) -> tuple[float, ...]:
    """Properties of a specimen on which its tables and the depth of its presses depend."""
    fixture, height = made.fixture, np.log(made.design.thickness)
    gel = np.log(made.mechanics.gel.shear_modulus)
    around = np.log(made.mechanics.encapsulation.shear_modulus)
    offset = 0.0 if isinstance(fixture, FreeArc) else fixture.offset
    # Depth over thickness depends on force over modulus times thickness squared.
    soft = (gel + 2.0 * height, around + 2.0 * height, gel + around + 4.0 * height)
    return (height, around - gel, free_length(fixture), offset, *soft)


def _clamped(
    recipe: Recipe, specimens: Sequence[int] | None
) -> Iterator[tuple[SensorDesign, Clamp, Mechanics, SensorGrid]]:
    """Designs, clamps, materials and grids of specimens on all supports on which clamps bend."""
    supports = [group.support for group in recipe.scenes if any(group.angle_deg)]
    supports += [None for each in recipe.episodes if any(each.angles_deg)]
    for made in _on_supports(recipe, specimens, supports):
        if isinstance(made.fixture, Clamp):
            yield made.design, made.fixture, made.mechanics, made.grid


def _pressed(
    recipe: Recipe, indenter: AnyIndenter, specimens: Sequence[int] | None
) -> Iterator[tuple[SensorDesign, Mechanics, AnyIndenter, SensorGrid]]:
    """Designs, materials and grids of specimens on all supports on which the indenter presses."""
    touched = [group for group in recipe.scenes if group.state == "touch"]
    supports: list[Support | None] = []
    if recipe.episodes and indenter == Cylinder():
        supports.append(None)
    supports += [group.support for group in touched if group.pressed_by == indenter]
    for made in _on_supports(recipe, specimens, supports):
        yield made.design, made.mechanics, indenter, made.grid


def _on_supports(
    recipe: Recipe, specimens: Sequence[int] | None, supports: Sequence[Support | None]
) -> Iterator[Specimen]:
    """Specimens on each of the supports, where None is their own."""
    if supports:
        for number in deciding_specimens(recipe) if specimens is None else specimens:
            made = specimen(recipe, number)
            for support in dict.fromkeys(each or made.design.support for each in supports):
                design = dataclasses.replace(made.design, support=support)
                yield dataclasses.replace(made, design=design)
