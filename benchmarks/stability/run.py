"""Run of all stiff and extreme cases and their outcomes: `eitskin bench stability`.

Every case must give a number that can be trusted or a ConfigurationError that says what was wrong.
Errors are against closed forms or rigorous bounds, invariants are what always holds of a case's
family, and residuals say how many digits rounding left; `CaseValues` says which is which.
"""

import time
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, get_args

from eitskin.benchmarks.results import Report, ReportTable, Watch, make_results
from eitskin.benchmarks.stability import bends, electrical, extremes, solids
from eitskin.benchmarks.stability.case import QUANTITIES, Case, Outcome, judge
from eitskin.benchmarks.stability.ordinary_designs import ordinary_designs
from eitskin.benchmarks.stability.random_designs import random_designs
from eitskin.threads import one_thread

_SHOWN = ("extreme presses", "ordinary designs")  # families whose cases are figures, one by one


def cases(seed: int, quick: bool) -> dict[str, Iterable[Case]]:
    """All cases, by family; quick ones are fewer and smaller, half a minute instead of ten."""
    ratios = (1e-6, 1e6) if quick else (1e-6, 1e-4, 1e-2, 1e2, 1e4, 1e6)
    shares = (0.01,) if quick else (0.5, 0.1, 0.01, 1e-3)
    return {
        "bends": bends.bends(quick),
        "rolls and twists": bends.rolls_and_twists(quick),
        "compositions": bends.compositions(quick),
        "incompressible": solids.incompressible(quick),
        "presses": solids.presses(quick),
        "whole stacks": solids.stacks(quick),
        "extreme presses": extremes.extremes(quick),
        "conductivity contrast": electrical.contrasts(ratios),
        "contact impedance": electrical.contacts(),
        "electrodes": electrical.electrodes(quick),
        "thin layers": electrical.layers((1e-6, 1.0, 1e6), shares),
        "cells": electrical.cells(quick),
        "ordinary designs": ordinary_designs(quick),
        "random designs": random_designs(seed, 20 if quick else 300),
    }


def run(seed: int, quick: bool, watch: Watch = lambda _, items: items) -> Report:
    """Compute and test all cases on one core; the report fails where one is wrong."""
    began = time.perf_counter()
    with one_thread():
        rows = [
            judge(case, family)
            for family, some in cases(seed, quick).items()
            for case in watch(family, list(some))
        ]
    own = {row["case"]: numbers for row in rows if (numbers := row.pop("figures"))}
    refused = (row for row in rows if row["family"] in _SHOWN and row["outcome"] == "refused")
    own |= {row["case"]: {"refused": 1.0} for row in refused}
    figures = dict(_figures(rows)) | {"all.seconds": time.perf_counter() - began}
    figures |= {f"{case} / {key}": each[key] for case, each in own.items() for key in each}
    wrong = [row for row in rows if row["outcome"] == "wrong"]
    remarks = ["wrong {family}, {case}: {reason}".format_map(row) for row in wrong]
    remarks += ["{family}, {case}: {reached}".format_map(row) for row in rows if row["reached"]]
    families = ["all", *dict.fromkeys(row["family"] for row in rows)]
    heads = ("cases", *get_args(Outcome), *QUANTITIES)
    cells = [(name, *(_cell(figures.get(f"{name}.{head}")) for head in heads)) for name in families]
    return Report(
        results=make_results("stability", figures.items(), began=began, seed=seed, quick=quick),
        rows=rows,
        tables=[ReportTable(("family", *heads), cells)],
        sentences=remarks,
        failed=bool(wrong),
    )


def _cell(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.0f}" if value == int(value) else f"{value:.0e}"


def _figures(rows: Sequence[dict[str, Any]]) -> Iterator[tuple[str, float]]:
    """Figures of each family and of all: counts of the outcomes and worst values."""
    families = {"all": list(rows)}
    for row in rows:
        families.setdefault(row["family"], []).append(row)
    for name, some in families.items():
        yield f"{name}.cases", len(some)
        for outcome in get_args(Outcome):
            yield f"{name}.{outcome}", sum(row["outcome"] == outcome for row in some)
        for quantity in QUANTITIES:
            worst = [value for row in some if (value := row[quantity]) is not None]
            if worst:
                yield f"{name}.{quantity}", max(worst)
