"""Record of a reading as plain data for JSON, the same in every stream and in `live --json`."""

import math
from typing import Any

import numpy as np

from eitskin.datasets.store.schema import State
from eitskin.frame import Frame, Status
from eitskin.hardware.boards.board import Counts
from eitskin.hardware.live import Estimate, Reading

VERSION = 1
"""Version of the records; keys may be added without a new one, none is removed or changed."""


def reading_record(reading: Reading, counts: Counts) -> dict[str, Any]:
    """Record of one reading; null stands for what is unknown or not estimated.

    docs/robot.md lists the keys with their units.

    Args:
        reading: from the live loop.
        counts: of the board at that moment.
    """
    frame, estimate = reading.frame, reading.estimate
    return {
        "version": VERSION,
        "kind": "reading",
        "number": frame.number,
        "session": frame.session,
        "time": known(frame.time),
        "wall_time": known(reading.wall_time),
        **(_without_estimate(reading) if estimate is None else _estimated(estimate)),
        "bad_channels": bad_channels(frame),
        "latency_ms": reading.latency * 1e3,
        "rate_hz": known(reading.rate),
        "lost": counts.lost,
        "skipped": counts.skipped,
        "unusable": reading.unusable,
        "reconnections": counts.reconnections,
        "dropped": dict(counts.dropped),
    }


def silence_record(seconds: float, problem: str) -> dict[str, Any]:
    """Record of a second without a frame.

    Args:
        seconds: since the newest reading; since the beginning before the first.
        problem: reason why no frames come, where known.
    """
    return {"version": VERSION, "kind": "silence", "seconds": seconds, "problem": problem}


def _estimated(estimate: Estimate) -> dict[str, Any]:
    values = np.asarray(estimate.probabilities, dtype=float).tolist()
    names = (state.name.lower() for state in State)
    return {
        "state": state_name(estimate),
        "probabilities": dict(zip(names, map(known, values), strict=True)),
        "bend_angle_deg": known(estimate.bend_angle_deg),
        "bend_deviation_deg": known(getattr(estimate, "bend_deviation_deg", None)),
        "touches": _touches(estimate),
        "zero": zero_name(estimate),
        "problems": list(estimate.problems),
    }


def _touches(estimate: Estimate) -> list[dict[str, float | None]] | None:
    """Record of each touch; None where touches are not estimated."""
    if estimate.touches is None:
        return None
    return [
        {
            "x": known(touch[0]),
            "y": known(touch[1]),
            "strength": known(touch[2]),
            "force": known(getattr(touch, "force", None)),
            "deviation": known(getattr(touch, "deviation", None)),
        }
        for touch in estimate.touches
    ]


def _without_estimate(reading: Reading) -> dict[str, Any]:
    """Estimate of a frame that was too damaged for one."""
    names = ("state", "probabilities", "bend_angle_deg", "bend_deviation_deg", "touches", "zero")
    return {**dict.fromkeys(names), "problems": [reading.problem]}


def bad_channels(frame: Frame) -> dict[str, str]:
    """Status of each bad measurement, by its label."""
    return {
        label: _status_text(int(bits))
        for label, bits in zip(frame.protocol.labels, frame.status, strict=True)
        if bits
    }


def state_name(estimate: Estimate) -> str | None:
    """Name of the state in lower case; None where the pipeline does not estimate it."""
    state = estimate.state
    if state is None:
        return None
    return (state if isinstance(state, str) else state.name).lower()


def zero_name(estimate: Estimate) -> str:
    """State of the sensor that an estimate is relative to, in words."""
    return str(getattr(estimate, "zero", "first frames"))


def known(value: float | None) -> float | None:
    """`value`, None where it is unknown or not finite, which JSON cannot say."""
    return float(value) if value is not None and math.isfinite(value) else None


def _status_text(bits: int) -> str:
    names = [flag.name.lower().replace("_", " ") for flag in Status if flag.name and flag & bits]
    return ", ".join(names) or f"status {bits:#04x}"
