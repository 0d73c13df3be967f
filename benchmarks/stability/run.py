"""Run of all stiff and extreme cases and their outcomes: `eitskin bench stability`.

Every case must give a number that can be trusted or a ConfigurationError that says what was wrong.
Errors are against closed forms or rigorous bounds, invariants are what always holds of a case's
family, and residuals say how many digits rounding left; `CaseValues` says which is which.
"""

import dataclasses
import time
from collections import Counter
from collections.abc import Iterator, Sequence

from eitskin.benchmarks.results import Report, ReportTable, Watch, measured
from eitskin.benchmarks.stability import bends, electrical, solids
from eitskin.benchmarks.stability.case import Case, CaseResult, judge
from eitskin.benchmarks.stability.random_designs import random_designs
from eitskin.threads import one_thread

_OUTCOMES = ("ok", "refused", "left out", "wrong")
_QUANTITIES = ("residual", "invariant", "error")


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
    yield from solids.stacks(quick)
    yield from electrical.contrasts(ratios)
    yield from electrical.contacts()
    yield from electrical.electrodes(quick)
    yield from electrical.layers((1e-6, 1.0, 1e6), (0.01,) if quick else (0.5, 0.1, 0.01, 1e-3))
    yield from electrical.cells(quick)
    yield from random_designs(seed, 20 if quick else 300)


def run(seed: int, quick: bool, watch: Watch = lambda _, items: items) -> Report:
    """Compute and judge all cases on one core; the report fails where one is wrong.

    Args:
        seed, quick: as in `cases`.
        watch: gives back the items that its text is about; shows progress where wanted.
    """
    began = time.perf_counter()
    with one_thread():
        rows = [judge(case) for case in watch("cases", tuple(cases(seed, quick)))]
    figures = dict(_figures(rows)) | {"all.seconds": time.perf_counter() - began}
    wrong = [row for row in rows if row.outcome == "wrong"]
    remarks = [f"{row.outcome} {row.family}, {row.case}: {row.reason}" for row in wrong]
    remarks += [f"{row.family}, {row.case}: {row.reached}" for row in rows if row.reached]
    families = ["all", *dict.fromkeys(row.family for row in rows)]
    heads = ("cases", *_OUTCOMES, *_QUANTITIES)
    cells = [(name, *(_cell(figures.get(f"{name}.{head}")) for head in heads)) for name in families]
    return Report(
        results=measured("stability", figures.items(), began=began, seed=seed, quick=quick),
        rows=[dataclasses.asdict(row) for row in rows],
        tables=[ReportTable(("family", *heads), cells)],
        sentences=remarks,
        failed=bool(wrong),
    )


def _cell(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.0f}" if value == int(value) else f"{value:.0e}"


def _figures(rows: Sequence[CaseResult]) -> Iterator[tuple[str, float]]:
    """Figures of each family and of all: counts of the outcomes and worst values."""
    families = {"all": list(rows)}
    for row in rows:
        families.setdefault(row.family, []).append(row)
    for name, some in families.items():
        yield f"{name}.cases", len(some)
        counts = Counter[str](row.outcome for row in some)
        for outcome in _OUTCOMES:
            yield f"{name}.{outcome}", counts[outcome]
        for quantity in _QUANTITIES:
            worst = [value for row in some if (value := getattr(row, quantity)) is not None]
            if worst:
                yield f"{name}.{quantity}", max(worst)
