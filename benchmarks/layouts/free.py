"""Search for the best positions of eight electrodes on the rim, without any symmetry.

Exchanges find many candidates by the guesses of `layouts_ring`: from random layouts one electrode
after the other goes to the best free place of the ring, until none is better anywhere. The
best of these, and layouts that are known to be good, are judged by their bounds; the best of all
then moves one electrode at a time by smaller steps.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from eitskin.benchmarks.layouts.bound import Sampling
from eitskin.benchmarks.layouts.candidates import SIZE
from eitskin.benchmarks.layouts.ring import Ring
from eitskin.benchmarks.layouts.search import COUNT, PERIMETER, Arcs, Candidate, best_of
from eitskin.benchmarks.layouts.store import Judge

_DIGITS = 9  # of arc lengths in metres


@dataclass(frozen=True, slots=True)
class FreePlan:
    """Extent of the search without symmetry.

    Attributes:
        pitch: between the places of the ring [m].
        starts: random layouts that exchanges begin with.
        judged: candidates whose bounds are found.
        steps: of the electrodes of the best, one after the other [m].
        seed: of the random layouts.
        sampling: how each is judged.
    """

    pitch: float = 0.015
    starts: int = 40
    judged: int = 4
    steps: tuple[float, ...] = (0.0075,)
    seed: int = 0
    sampling: Sampling = Sampling(0.0075)  # noqa: RUF009 - frozen


QUICK = FreePlan(0.030, 2, 1, (), sampling=Sampling(0.0225))


def free_search(judge: Judge, ring: Ring, plan: FreePlan, known: Sequence[Arcs]) -> Candidate:
    """Best layout found, `known` ones included."""
    candidates = exchanged(ring, plan)[: plan.judged]
    best = best_of(judge, plan.sampling, [*known, *candidates])
    for step in plan.steps:
        best = _moved(judge, plan, best, step)
    return best


def exchanged(ring: Ring, plan: FreePlan) -> list[Arcs]:
    """Layouts that no exchange of one electrode improves, best guess first.

    Mirror images, which are equally good, are listed once.
    """
    rng = np.random.default_rng(plan.seed)
    found = {}
    for _ in range(plan.starts):
        guess, chosen = _exchanged(ring, rng.permutation(len(ring.arcs))[:COUNT].tolist())
        arcs = tuple(float(s) for s in np.round(ring.arcs[sorted(chosen)], _DIGITS))
        found[min(images(arcs))] = guess
    return sorted(found, key=lambda arcs: (found[arcs], arcs))


def images(arcs: Arcs) -> Iterator[Arcs]:
    """Layout and its mirror images."""
    half = PERIMETER / 2
    for sign, start in ((1.0, 0.0), (1.0, half), (-1.0, SIZE[0]), (-1.0, SIZE[0] + half)):
        image = np.round((start + sign * np.array(arcs)) % PERIMETER, _DIGITS)
        yield tuple(np.sort(image).tolist())


def _exchanged(ring: Ring, chosen: list[int]) -> tuple[float, list[int]]:
    """Exchange electrodes of a layout one at a time until no exchange improves it."""
    best, before = ring.guess(chosen), np.inf
    while best < before:
        before = best
        for i in range(len(chosen)):
            others = [*chosen[:i], *chosen[i + 1 :]]
            for place in sorted(set(range(len(ring.arcs))) - set(chosen)):
                guess = ring.guess([*others, place])
                if guess < best:
                    best, chosen = guess, [*others[:i], place, *others[i:]]
    return best, chosen


def _moved(judge: Judge, plan: FreePlan, best: Candidate, step: float) -> Candidate:
    """Move one electrode after the other until no step improves the layout."""
    arcs, turn, unmoved = list(best.arcs), 0, 0
    while unmoved < COUNT:
        others = [*arcs[:turn], *arcs[turn + 1 :]]
        there = [round((arcs[turn] + by) % PERIMETER, _DIGITS) for by in (-step, step)]
        layouts = {tuple(sorted((*others, arc))): arc for arc in there}
        found = best_of(judge, plan.sampling, list(layouts))
        unmoved += 1
        if found.score < best.score:
            best, arcs[turn], unmoved = found, layouts[found.arcs], 0
        turn = (turn + 1) % COUNT
    return best
