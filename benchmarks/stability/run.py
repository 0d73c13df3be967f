"""Run of all stiff and extreme cases and their outcomes: `eitskin bench stability`.

Every case must give a number that can be trusted or a ConfigurationError that says what was wrong.
Errors are against closed forms or rigorous bounds, invariants are what always holds of a case's
family, and residuals say how many digits rounding left; `CaseValues` says which is which.
"""

import dataclasses
import re
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from eitskin.benchmarks.results import Results, write_results
from eitskin.benchmarks.stability import bends, electrical, places, solids, stacks
from eitskin.benchmarks.stability.case import Case, CaseResult, judge
from eitskin.benchmarks.stability.random_designs import RANDOM, random_designs
from eitskin.provenance import Provenance
from eitskin.threads import one_thread

Watch: TypeAlias = Callable[[str, Sequence[Any]], Iterable[Any]]

_NUMBERS = re.compile(r"[-+]?\d[\d.]*(e[-+]?\d+)?j?")


@dataclass(frozen=True, slots=True)
class Stability:
    """Outcomes of all cases of one run.

    Attributes:
        provenance: what it was measured with.
        seconds: that the run took [s].
        quick: whether fewer and smaller cases had to do.
        rows: of all cases, random ones each by itself.
    """

    provenance: Provenance
    seconds: float
    quick: bool
    rows: tuple[CaseResult, ...]

    @property
    def wrong(self) -> tuple[CaseResult, ...]:
        """Rows of the cases that went wrong."""
        return tuple(row for row in self.rows if row.outcome == "wrong")


def cases(seed: int, quick: bool) -> Iterator[Case]:
    """All cases, by family.

    Args:
        seed: of the random designs.
        quick: fewer and smaller ones, in half a minute instead of ten.
    """
    ratios = (1e-6, 1e6) if quick else (1e-6, 1e-4, 1e-2, 1e2, 1e4, 1e6)
    yield from bends.bends(quick)
    yield from bends.rolls_and_twists(quick)
    yield from bends.compositions(quick)
    yield from solids.incompressible(quick)
    yield from solids.presses(quick)
    yield from stacks.stacks(quick)
    yield from electrical.contrasts(ratios)
    yield from electrical.contacts()
    yield from places.electrodes(quick)
    yield from electrical.layers((1e-6, 1.0, 1e6), (0.01,) if quick else (0.5, 0.1, 0.01, 1e-3))
    yield from places.cells(quick)
    yield from random_designs(seed, 20 if quick else 300)


def run(seed: int, quick: bool, watch: Watch = lambda _, items: items) -> Stability:
    """Compute and judge all cases on one core.

    Args:
        seed, quick: as in `cases`.
        watch: gives back the items that its text is about; shows progress where wanted.
    """
    start = time.perf_counter()
    with one_thread():
        rows = tuple(judge(case) for case in watch("cases", tuple(cases(seed, quick))))
    return Stability(Provenance.now(seed), time.perf_counter() - start, quick, rows)


def write(found: Stability, out: Path) -> list[Path]:
    """Write results and all rows as table.csv into `out/stability`, each whole."""
    results = Results(
        name="stability",
        command=f"eitskin bench stability --seed {found.provenance.seed}"
        + " --quick" * found.quick,
        provenance=found.provenance,
        seconds=found.seconds,
        quick=found.quick,
        figures=dict(figures(found)),
    )
    return write_results(results, out, [dataclasses.asdict(row) for row in found.rows])


def figures(found: Stability) -> Iterator[tuple[str, float]]:
    """Figures of each family and of all: counts of the outcomes and worst values."""
    yield "all.seconds", found.seconds
    families = {"all": found.rows}
    for name in dict.fromkeys(row.family for row in found.rows):
        families[name] = tuple(row for row in found.rows if row.family == name)
    for name, rows in families.items():
        yield f"{name}.cases", len(rows)
        counts = Counter(row.outcome for row in rows)
        for outcome in ("ok", "refused", "left out", "wrong"):
            yield f"{name}.{outcome}", counts[outcome]
        for quantity in ("residual", "invariant", "error"):
            worst = [value for row in rows if (value := getattr(row, quantity)) is not None]
            if worst:
                yield f"{name}.{quantity}", max(worst)


def tallied(rows: Sequence[CaseResult]) -> list[CaseResult]:
    """Rows of all cases; random designs are grouped by outcome and kind of message.

    Their case says how many they are, numbers are the worst, and seconds the sum.
    """
    kinds: dict[tuple[str, str], list[CaseResult]] = {}
    for row in rows:
        if row.family == RANDOM:
            kinds.setdefault((row.outcome, _NUMBERS.sub("#", row.reason)), []).append(row)
    alone = [row for row in rows if row.family != RANDOM]
    return alone + [_together(same) for same in sorted(kinds.values(), key=len, reverse=True)]


def _together(rows: Sequence[CaseResult]) -> CaseResult:
    invariants = [row.invariant for row in rows if row.invariant is not None]
    kind = _NUMBERS.sub("#", rows[0].reason)
    return dataclasses.replace(
        rows[0],
        case=f"{len(rows)}: {kind}" if kind else f"{len(rows)}",
        invariant=max(invariants, default=None),
        seconds=sum(row.seconds for row in rows),
    )
