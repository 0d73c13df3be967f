"""Stiff or extreme case, its values and its outcome."""

import math
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from eitskin.geometry import ConfigurationError

Outcome = Literal["ok", "refused", "left out", "wrong"]
QUANTITIES = ("residual", "invariant", "error")

_PATIENCE = 300.0  # s: what takes longer counts as a hang


@dataclass(frozen=True, slots=True)
class CaseValues:
    """Values of one case; None where a quantity does not apply.

    Attributes:
        residual: of electrical cases, largest relative difference between the impedances by two
            direct solvers, which eliminate in another order; of mechanical ones, largest
            unbalanced force over the largest force. Condition times the precision of numbers.
        invariant: worst relative violation of what always holds; see the families.
        error: relative, against a closed form, or outside rigorous bounds.
        reached: in words, how far it went.
        reason: why it went no further.
    """

    residual: float | None = None
    invariant: float | None = None
    error: float | None = None
    reached: str = ""
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Case:
    """Case to compute and its expected outcome.

    Attributes:
        name: what is special about it.
        solve: computes it; raises ConfigurationError where it cannot be.
        expected: whether it can be; None where either will do.
        says: what a refusal must say.
        residual_limit, invariant_limit, error_limit: beyond which the result is wrong.
    """

    name: str
    solve: Callable[[], CaseValues]
    expected: Literal["ok", "refused"] | None = "ok"
    says: str = ""
    residual_limit: float = math.inf
    invariant_limit: float = 1e-6
    error_limit: float = 1e-3


@dataclass(frozen=True, slots=True)
class CaseResult(CaseValues):
    """Outcome of one case beside its values; None also for what is not a number.

    Attributes:
        family: row of the table of extreme cases that it belongs to.
        case: its name.
        outcome: "ok"; "refused" by a ConfigurationError; "left out" where something is not
            installed; or "wrong": not a number, beyond a limit, another exception, a hang, or
            another outcome than the expected one.
        seconds: that it took [s].
    """

    family: str = ""
    case: str = ""
    outcome: Outcome = "ok"
    seconds: float = 0.0


def judge(case: Case, family: str = "", patience: float = _PATIENCE) -> CaseResult:
    """Compute a case and judge its outcome; a warning counts as a failure.

    Where the system has no alarm clock, hangs are not ended.
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
        outcome, reason = _refusal(case, str(error))
    except ImportError as error:
        outcome, reason = "left out", str(error)
    except Exception as error:  # whatever else comes is a bug to be listed
        outcome, reason = "wrong", f"{type(error).__name__}: {error}"
    row: dict[str, Any] = asdict(values) | {"reason": reason}
    for name in QUANTITIES:
        row[name] = None if row[name] is None or not np.isfinite(row[name]) else float(row[name])
    seconds = time.perf_counter() - start
    return CaseResult(**row, family=family, case=case.name, outcome=outcome, seconds=seconds)


def _outcome(case: Case, values: CaseValues) -> tuple[Outcome, str]:
    for name in QUANTITIES:
        value, limit = getattr(values, name), getattr(case, f"{name}_limit")
        if value is None:
            continue
        if not np.isfinite(value):
            return "wrong", f"{name} is not a number"
        if value > limit:
            return "wrong", f"{name} of {value:.2g}, at most {limit:g} was expected"
    if values.reason:
        return _refusal(case, values.reason)
    if case.expected == "refused":
        return "wrong", "was not refused"
    return "ok", ""


def _refusal(case: Case, reason: str) -> tuple[Outcome, str]:
    if case.expected == "ok":
        return "wrong", f"was refused: {reason}"
    if case.says not in reason:
        return "wrong", f"the refusal does not say '{case.says}': {reason}"
    return "refused", reason


@contextmanager
def _alarm(seconds: float) -> Iterator[None]:
    """Raise TimeoutError in the block after some time, where the system can."""
    if not hasattr(signal, "setitimer") or threading.current_thread() != threading.main_thread():
        yield
        return

    def ring(*_: Any) -> None:
        raise TimeoutError(f"took longer than {seconds:g} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
