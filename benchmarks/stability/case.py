"""Stiff or extreme case, its values and its outcome."""

import math
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np

from eitskin.geometry import ConfigurationError

Outcome = Literal["ok", "refused", "left out", "wrong"]
QUANTITIES = ("residual", "invariant", "error")

_PATIENCE = 900.0  # s of processor time: what takes longer counts as a hang


@dataclass(frozen=True, slots=True)
class CaseValues:
    """Values of one case; None where a quantity does not apply.

    Attributes:
        residual: residual of electrical cases, largest relative difference between the impedances
            by two direct solvers, which eliminate in another order; of mechanical ones, largest
            unbalanced force over the largest force. Condition times the precision of numbers.
        invariant: worst relative violation of what always holds; see the families.
        error: relative, against a closed form, or outside rigorous bounds.
        reached: progress, in words.
        reason: why it went no further.
        figures: numbers of this case that pages show, by their headings.
    """

    residual: float | None = None
    invariant: float | None = None
    error: float | None = None
    reached: str = ""
    reason: str = ""
    figures: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Case:
    """Case to compute and its expected outcome.

    Attributes:
        name: name by its special quantity.
        solve: computes it; raises ConfigurationError where it cannot be.
        expected: whether it can be; None where either will do.
        says: text that a refusal must have.
        residual_limit, invariant_limit, error_limit: beyond which the result is wrong.
    """

    name: str
    solve: Callable[[], CaseValues]
    expected: Literal["ok", "refused"] | None = "ok"
    says: str = ""
    residual_limit: float = math.inf
    invariant_limit: float = 1e-6
    error_limit: float = 1e-3


def judge(case: Case, family: str = "", patience: float = _PATIENCE) -> dict[str, Any]:
    """Compute a case and test its outcome; a warning counts as a failure.

    Where the system has no alarm clock, hangs are not ended.

    Returns the row of table.csv: the case's values, None also for what is not a number; `family`,
    the row of the table of extreme cases that it belongs to; `case`, its name; `seconds` [s]; and
    `outcome`: "ok"; "refused" by a ConfigurationError; "left out" where something is not installed;
    or "wrong": not a number, beyond a limit, another exception or outcome, or a hang.
    """
    start = time.perf_counter()
    outcome: Outcome
    values = CaseValues()
    try:
        with _alarm(patience), warnings.catch_warnings():
            warnings.simplefilter("error")
            values = case.solve()
        outcome, reason = _outcome(case, values)
    except ConfigurationError as error:
        outcome, reason = _outcome(case, CaseValues(reason=str(error)))
    except ImportError as error:
        outcome, reason = "left out", str(error)
    except Exception as error:  # whatever else comes is a bug to be listed
        outcome, reason = "wrong", f"{type(error).__name__}: {error}"
    row: dict[str, Any] = asdict(values) | {"reason": reason}
    for name in QUANTITIES:
        row[name] = None if row[name] is None or not np.isfinite(row[name]) else float(row[name])
    seconds = time.perf_counter() - start
    return row | {"family": family, "case": case.name, "outcome": outcome, "seconds": seconds}


def _outcome(case: Case, values: CaseValues) -> tuple[Outcome, str]:
    """Outcome of a case that ended, with its reason."""
    for name in QUANTITIES:
        value, limit = getattr(values, name), getattr(case, f"{name}_limit")
        if value is not None and not np.isfinite(value):
            return "wrong", f"{name} is not a number"
        if value is not None and value > limit:
            return "wrong", f"{name} of {value:.2g}, at most {limit:g} was expected"
    if not values.reason:
        return ("wrong", "was not refused") if case.expected == "refused" else ("ok", "")
    if case.expected == "ok":
        return "wrong", f"was refused: {values.reason}"
    if case.says not in values.reason:
        return "wrong", f"the refusal does not say '{case.says}': {values.reason}"
    return "refused", values.reason


@contextmanager
def _alarm(seconds: float) -> Iterator[None]:
    """Raise TimeoutError in the block after some processor time, where the system can."""
    if not hasattr(signal, "setitimer") or threading.current_thread() != threading.main_thread():
        yield
        return

    def ring(*_: Any) -> None:
        raise TimeoutError(f"took longer than {seconds:g} s")

    before = signal.signal(signal.SIGPROF, ring)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)
