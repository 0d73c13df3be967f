"""Search for the best symmetric positions of eight electrodes on the rim.

First all layouts that both middle lines of the sheet mirror: two quadruples of electrodes, or one
and the two pairs on the middle lines, as the paper's. Then smaller steps from the best, and at last
steps of layouts that only a half turn leaves as they are. Nothing is random: the search replays
from the bounds that are kept, and so goes on where it was stopped.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.layouts.bound import Judge, Sampling, SheetBound
from eitskin.benchmarks.layouts.candidates import SIZE, Layout, with_electrodes
from eitskin.errors import ConfigurationError
from eitskin.geometry.design.electrode import Electrode
from eitskin.geometry.design.outline import Rectangle

Array = NDArray[np.float64]
Arcs = tuple[float, ...]

WIDTH = 0.005  # of an electrode, and least gap between two [m]
COUNT = 8
_OUTLINE = Rectangle(*SIZE)
_LENGTH, PERIMETER = SIZE[0], _OUTLINE.perimeter
_MIDDLE = _LENGTH / 2  # arc length of the middle of the lower side
_QUARTER = PERIMETER / 4  # from there to the middle of the right side
_PAPER = (0.0525,)  # the paper's: four electrodes so far from there, and those on the middle lines


@dataclass(frozen=True, slots=True)
class SearchPlan:
    """Extent of the search with symmetry.

    Attributes:
        first: step of the first layouts along the rim [m].
        smaller: steps from the best of them, one after the other [m].
        turned: steps of layouts with a half turn alone [m].
        sampling: how each is judged.
    """

    first: float = 0.015
    smaller: tuple[float, ...] = (0.0075, 0.00375)
    turned: tuple[float, ...] = (0.0075,)
    sampling: Sampling = Sampling(0.0075)  # noqa: RUF009 - frozen


QUICK = SearchPlan(0.030, (0.015,), (), Sampling(0.0225))


@dataclass(frozen=True, slots=True)
class Candidate:
    """Candidate layout on the rim: ascending arc lengths of its electrodes' middles [m]."""

    arcs: Arcs
    score: float

    @property
    def layout(self) -> Layout:
        """Layout with 5 mm electrodes at these arc lengths."""
        return at_arcs("best found", self.arcs)


def score(bound: SheetBound) -> float:
    """Objective of the search: 90th percentile over the sheet of the position bound [m]."""
    return float(np.percentile(bound.place, 90))


def at_arcs(name: str, arcs: Arcs, width: float = WIDTH) -> Layout:
    """Layout of electrodes at arc lengths of the rim [m], 5 mm wide by default.

    Raises ConfigurationError for less than 5 mm between two, or one that passes a corner.
    """
    if not possible(arcs, width):
        raise ConfigurationError(
            f"electrodes of {1e3 * width:g} mm at "
            f"{', '.join(f'{1e3 * s:g}' for s in arcs)} mm along the rim are less than "
            f"{1e3 * WIDTH:g} mm apart, or pass a corner; move them"
        )
    places = np.round(_OUTLINE.at(np.array(arcs)), 12) + 0.0
    return with_electrodes(name, [Electrode(x, y, width) for x, y in places.tolist()])


def search(judge: Judge, plan: SearchPlan) -> tuple[Candidate, Candidate]:
    """Best layout with both mirrors, and best with at least a half turn."""
    best = best_of(
        judge, plan.sampling, [_both_mirrors(each) for each in (_PAPER, *_coarse(plan.first))]
    )
    for step in plan.smaller:
        best = _descended(judge, plan, best, _mirrored_parameters(best.arcs), step)
    turned = best
    for step in plan.turned:
        half = tuple(s for s in turned.arcs if _turn(s) > s)
        turned = _descended(judge, plan, turned, half, step)
    return best, turned


def _coarse(step: float) -> list[Arcs]:
    """Parameters on a lattice: one quadruple with both pairs, or two quadruples."""
    along = np.arange(step, _QUARTER - 0.5 * step, step).tolist()
    return [(t,) for t in along] + list(itertools.combinations(along, 2))


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


def _mirrored_parameters(arcs: Arcs) -> Arcs:
    distances = {round(s - _MIDDLE, 9) for s in arcs}
    return tuple(sorted(t for t in distances if 1e-6 < t < _QUARTER - 1e-6))


def _half_turn(parameters: Arcs) -> Arcs:
    return tuple(sorted({s for t in parameters for s in (round(t % PERIMETER, 9), _turn(t))}))


def _turn(arc: float) -> float:
    return round((arc + 2.0 * _QUARTER) % PERIMETER, 9)


def _descended(
    judge: Judge, plan: SearchPlan, best: Candidate, parameters: Arcs, step: float
) -> Candidate:
    """Descend by the best step of one parameter at a time until no step improves the layout.

    With one or two parameters layouts have both mirrors, with four a half turn.
    """
    whole = _half_turn if len(parameters) > COUNT // 4 else _both_mirrors
    while True:
        moved = [
            (*parameters[:i], round(parameters[i] + by, 9), *parameters[i + 1 :])
            for i in range(len(parameters))
            for by in (-step, step)
        ]
        by_arcs = {whole(each): each for each in moved}
        found = best_of(judge, plan.sampling, list(by_arcs))
        if found.score >= best.score:
            return best
        best, parameters = found, by_arcs[found.arcs]


def best_of(judge: Judge, sampling: Sampling, layouts: Sequence[Arcs]) -> Candidate:
    """Best of the possible candidates; the first of equal ones."""
    layouts = [arcs for arcs in dict.fromkeys(layouts) if possible(arcs)]
    bounds = judge([(at_arcs(_name(arcs), arcs), sampling) for arcs in layouts])
    found = [Candidate(arcs, score(each)) for arcs, each in zip(layouts, bounds, strict=True)]
    return min(found, key=lambda each: each.score, default=Candidate((), np.inf))


def possible(arcs: Arcs, width: float = WIDTH) -> bool:
    """Whether eight electrodes are 5 mm apart and none lies across a corner."""
    s = np.sort(np.array(arcs))
    gaps = np.diff(s, append=s[:1] + PERIMETER)
    corners = np.append(_OUTLINE.corners, PERIMETER)
    from_corner = np.abs(s[:, None] - corners).min(axis=1)
    near = 1e-9
    return bool(
        len(s) == COUNT
        and np.all(gaps >= width + WIDTH - near)
        and np.all(from_corner >= 0.5 * width - near)
    )


def _name(arcs: Arcs) -> str:
    return "rim at " + ", ".join(f"{1e3 * s:g}" for s in arcs if s < 2.0 * _QUARTER)
