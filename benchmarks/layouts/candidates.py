"""Electrode layouts that `eitskin bench layouts` compares: sweeps, and a search.

The search is for the best symmetric positions of eight electrodes on the rim. First all layouts
that both middle lines of the sheet mirror: two quadruples of electrodes, or one and the two pairs
on the middle lines, as the paper's. Then smaller steps from the best, and at last steps of layouts
that only a half turn leaves as they are. Nothing is random: the search replays from the bounds that
are kept, and so goes on where it was stopped.
"""

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from eitskin.benchmarks.layouts.bound import Judge, Layout, Sampling
from eitskin.geometry import ConfigurationError, Electrode, Rectangle, SensorDesign
from eitskin.geometry.design.regular_layouts import grid, uniform

PAPER = "paper: 8 on the rim"
COUNTS = (6, 8, 10, 12, 16, 32)
WIDTHS = (0.002, 0.0035, 0.005, 0.008, 0.012)  # along the rim [m]
CONTACTS = (1e-5, 1e-4, 1e-3, 1e-2)  # [ohm m2]
BENT_COUNTS = (8, 12, 16, 32)  # of electrodes on the rim of bent sheets
ANGLES = (-20.0, -10.0, 0.0, 10.0, 20.0, 30.0, 40.0, 50.0)  # [deg]
SIZE = (0.150, 0.060)  # of the paper's sensor [m]
_OUTLINE = Rectangle(*SIZE)
_RIM = 0.005  # from the rim to the middle of a pad next to it [m]


def paper(angle_deg: float = 0.0) -> Layout:
    """Layout of the paper's sensor at a bend angle [deg]."""
    return Layout(PAPER, SensorDesign.reference(), angle_deg)


def with_electrodes(name: str, electrodes: Sequence[Electrode]) -> Layout:
    """Layout of the paper's sensor with other electrodes.

    Raises ConfigurationError, naming the layout, for electrodes that overlap or do not fit.
    """
    try:
        design = dataclasses.replace(SensorDesign.reference(), electrodes=tuple(electrodes))
    except ConfigurationError as error:
        raise ConfigurationError(f"layout '{name}': {error}") from error
    return Layout(name, design)


def sweeps() -> dict[str, tuple[Layout, ...]]:
    """Layouts by the name of their sweep; the paper's layout is in each."""
    return {
        "count": tuple(_rim_layout(count) for count in COUNTS),
        "placement": tuple(_placements()),
        "width": tuple(
            with_electrodes(f"{1e3 * width:g} mm wide", _rim_electrodes(8, width=width))
            for width in WIDTHS
        ),
        "contact": tuple(
            with_electrodes(f"{z:g} ohm m2", _rim_electrodes(8, contact_impedance=z))
            for z in CONTACTS
        ),
        "bend": tuple(_bent_layout(count, angle) for count in BENT_COUNTS for angle in ANGLES),
    }


def _rim_electrodes(
    count: int, width: float = 0.005, contact_impedance: float = 1e-3
) -> list[Electrode]:
    """Electrodes evenly spaced on the rim, one in the middle of the lower side as in the paper."""
    start = _OUTLINE.length / 2 % (_OUTLINE.perimeter / count)
    return list(uniform(_OUTLINE, count, width, start, contact_impedance))


def _rim_layout(count: int) -> Layout:
    return with_electrodes(f"{count} on the rim", _rim_electrodes(count))


def _bent_layout(count: int, angle_deg: float) -> Layout:
    name = f"{count}, {angle_deg:g} deg"
    return dataclasses.replace(_rim_layout(count), name=name, angle_deg=angle_deg)


def _placements() -> Iterator[Layout]:
    """Layouts of eight 5 mm electrodes: on the rim, on top next to it, on top all over, inside."""
    design = SensorDesign.reference()
    half = design.thickness / 2
    yield paper()
    rim = np.array([(e.x, e.y) for e in design.electrodes])
    kinds: tuple[tuple[Literal["top", "inside"], float | None, str], ...] = (
        ("top", None, "on top"),
        ("inside", half, "inside"),
    )
    for on, z, where in kinds:
        beside = np.clip(rim, _RIM, np.array(SIZE) - _RIM)
        pads = [Electrode(x, y, z=z, on=on) for x, y in beside.tolist()]
        yield with_electrodes(f"{where}, beside the rim", pads)
        spread = grid(_OUTLINE, 2, 4, 0.005, on=on, z=z)
        yield with_electrodes(f"{where}, 2 x 4", spread)


# The search

Arcs = tuple[float, ...]

WIDTH = 0.005  # of an electrode, and least gap between two [m]
COUNT = 8
PERIMETER = _OUTLINE.perimeter
_MIDDLE = SIZE[0] / 2  # arc length of the middle of the lower side
_QUARTER = PERIMETER / 4  # from there to the middle of the right side
_PAPER = (0.0525,)  # the paper's: four electrodes so far from there, and those on the middle lines


@dataclass(frozen=True, slots=True)
class SearchPlan:
    """Extent of the search with symmetry.

    Attributes:
        first: step of the first layouts along the rim [m].
        smaller: steps from the best of them, one after the other [m].
        turned: steps of layouts with a half turn alone [m].
        sampling: grid on which each is tested.
    """

    first: float = 0.015
    smaller: tuple[float, ...] = (0.0075, 0.00375)
    turned: tuple[float, ...] = (0.0075,)
    sampling: Sampling = Sampling(0.0075)  # noqa: RUF009 - frozen


QUICK = SearchPlan(0.030, (0.015,), (), Sampling(0.0225))


@dataclass(frozen=True, slots=True)
class Candidate:
    """Candidate layout on the rim, and the 90th percentile of its position bound [m].

    `arcs` are the ascending arc lengths of its electrodes' middles [m].
    """

    arcs: Arcs
    score: float


def layout_from_arcs(name: str, arcs: Arcs) -> Layout:
    """Layout of electrodes at arc lengths of the rim [m], 5 mm wide.

    Raises ConfigurationError for less than 5 mm between two, or one that passes a corner.
    """
    if not possible(arcs):
        raise ConfigurationError(
            f"electrodes of {1e3 * WIDTH:g} mm at "
            f"{', '.join(f'{1e3 * s:g}' for s in arcs)} mm along the rim are less than "
            f"{1e3 * WIDTH:g} mm apart, or pass a corner; move them"
        )
    places = np.round(_OUTLINE.rim_points(np.array(arcs)), 12) + 0.0
    return with_electrodes(name, [Electrode(x, y, WIDTH) for x, y in places.tolist()])


def search(judge: Judge, plan: SearchPlan) -> tuple[Candidate, Candidate]:
    """Best layout with both mirrors, and best with at least a half turn."""
    along = np.arange(plan.first, _QUARTER - 0.5 * plan.first, plan.first).tolist()
    # On a lattice: one quadruple with both pairs, or two quadruples.
    coarse = [_PAPER, *((t,) for t in along), *itertools.combinations(along, 2)]
    best = select_best(judge, plan.sampling, [_both_mirrors(each) for each in coarse])
    for step in plan.smaller:
        distances = {round(s - _MIDDLE, 9) for s in best.arcs}
        mirrored = tuple(sorted(t for t in distances if 1e-6 < t < _QUARTER - 1e-6))
        best = _coordinate_descent(judge, plan, best, mirrored, step)
    turned = best
    for step in plan.turned:
        half = tuple(s for s in turned.arcs if _turn(s) > s)
        turned = _coordinate_descent(judge, plan, turned, half, step)
    return best, turned


def _both_mirrors(parameters: Arcs) -> Arcs:
    """Arc lengths of all eight, from distances along the rim from the middle of the lower side."""
    alone = (0.0, _QUARTER) if len(parameters) == 1 else ()
    arcs = {
        round((_MIDDLE + sign * t + half) % PERIMETER, 9)
        for t in (*parameters, *alone)
        for sign in (1.0, -1.0)
        for half in (0.0, 2.0 * _QUARTER)
    }
    return tuple(sorted(arcs))


def _turn(arc: float) -> float:
    return round((arc + 2.0 * _QUARTER) % PERIMETER, 9)


def _coordinate_descent(
    judge: Judge, plan: SearchPlan, best: Candidate, parameters: Arcs, step: float
) -> Candidate:
    """Descend by the best step of one parameter at a time until no step improves the layout.

    With one or two parameters layouts have both mirrors, with four a half turn.
    """

    def half_turn(parameters: Arcs) -> Arcs:
        return tuple(sorted({s for t in parameters for s in (round(t % PERIMETER, 9), _turn(t))}))

    whole = half_turn if len(parameters) > COUNT // 4 else _both_mirrors
    while True:
        moved = [
            (*parameters[:i], round(parameters[i] + by, 9), *parameters[i + 1 :])
            for i in range(len(parameters))
            for by in (-step, step)
        ]
        by_arcs = {whole(each): each for each in moved}
        best_candidate = select_best(judge, plan.sampling, list(by_arcs))
        if best_candidate.score >= best.score:
            return best
        best, parameters = best_candidate, by_arcs[best_candidate.arcs]


def select_best(judge: Judge, sampling: Sampling, layouts: Sequence[Arcs]) -> Candidate:
    """Best of the possible candidates; the first of equal ones."""
    layouts = [arcs for arcs in dict.fromkeys(layouts) if possible(arcs)]
    names = ("rim at " + ", ".join(f"{1e3 * s:g}" for s in arcs[: COUNT // 2]) for arcs in layouts)
    bounds = judge(
        [(layout_from_arcs(*each), sampling) for each in zip(names, layouts, strict=True)]
    )
    scores = [float(np.percentile(bound.place, 90)) for bound in bounds]
    candidates = map(Candidate, layouts, scores)
    return min(candidates, key=lambda each: each.score, default=Candidate((), np.inf))


def possible(arcs: Arcs) -> bool:
    """Whether eight electrodes are 5 mm apart and none lies across a corner."""
    s = np.sort(np.array(arcs))
    gaps = np.diff(s, append=s[:1] + PERIMETER)
    corners = np.append(_OUTLINE.corners, PERIMETER)
    from_corner = np.abs(s[:, None] - corners).min(axis=1)
    near = 1e-9
    return bool(
        len(s) == COUNT
        and np.all(gaps >= 2.0 * WIDTH - near)
        and np.all(from_corner >= 0.5 * WIDTH - near)
    )
