"""Variation from frame to frame: frozen values, noise, and movement during the check."""

from collections.abc import Iterator

import numpy as np

from eitskin.hardware.diagnosis.checked_frames import (
    SHORT,
    Array,
    Bools,
    CheckedFrames,
    electrodes_at_fault,
)
from eitskin.hardware.diagnosis.finding import (
    Finding,
    FindingKind,
    channel_numbers,
    findings_by_electrode,
)

MOVED = 0.003
"""Relative change of all values in common between quarters of the check that is a movement."""
TOUCHED = 0.0003
"""The same beside the common change, rms over the channels."""
SIGNIFICANT = 6.0
"""Reduced chi-square of a change, and its ratio to the standard deviation, beyond noise."""
NOISY, NOISE = 4.0, 0.001
"""Noise of a noisy channel: in units of the median channel's noise, and relative to its value."""
NOISY_BOARD = 0.005
"""Noise of the median channel, relative to the rms of all, from which all values are noisy."""
FEWEST_FOR_NOISE = 8


def frozen(checked: CheckedFrames) -> Iterator[Finding]:
    """Findings of values that repeat to the last bit, which no measurement does."""
    same = np.diff(np.where(checked.finite, checked.impedance, 0.0), axis=0) == 0
    if len(same) < 2 or not checked.usable.any():
        return
    same[:, ~checked.usable] = True
    repeats = int(same.all(axis=1).sum())
    if repeats >= 2:
        text = (
            f"{repeats} of {len(same) + 1} frames repeat the one before: the board sends old "
            "values; restart it"
        )
        yield Finding(FindingKind.FROZEN, (), tuple(range(len(checked.expected))), text)
        return
    if (stuck := same.all(axis=0) & checked.usable & ~checked.opened & ~checked.shorted).any():
        remedy = "its value never changes, not even by noise: check its multiplexer path"
        yield from findings_by_electrode(FindingKind.STUCK, stuck, checked, "is stuck", remedy)


def unsteady(checked: CheckedFrames, rest: Bools) -> Iterator[Finding]:
    """Findings of noise and movement among the channels `rest`."""
    if len(checked.impedance) < FEWEST_FOR_NOISE or not rest.any():
        return
    value, noise = np.abs(checked.value), checked.noise
    relative = noise / np.maximum(value, SHORT * checked.expected)
    usual = float(np.median(noise[rest]))
    # White noise is that of the largest values, and far above many of those between neighbours.
    size = float(np.sqrt(np.mean(value[rest] ** 2)))
    if usual > NOISY_BOARD * size:
        text = (
            f"all values scatter by {100 * usual / size:.1f} % from frame to frame: check ground, "
            "shield and supply of the board, and that nothing moves"
        )
        yield Finding(FindingKind.NOISY, (), channel_numbers(rest), text)
    elif (noisy := rest & (noise > NOISY * usual) & (relative > NOISE)).any():
        yield from findings_by_electrode(
            FindingKind.NOISY, noisy, checked, "is noisy", "a loose wire or plug does this"
        )
        rest = rest & ~noisy
    yield from _moved(checked, rest, np.maximum(relative, np.median(relative[rest])))


def _moved(checked: CheckedFrames, rest: Bools, noise: Array) -> Iterator[Finding]:
    """Findings of relative changes beyond the noise between quarters of the check."""
    # In the units of `noise`: a value near zero, as between four terminals, is no unit of its own.
    size = np.abs(checked.value)
    unit = np.maximum(size, SHORT * checked.expected) / np.where(size == 0.0, 1.0, size)
    value = np.where(checked.value == 0.0, 1.0, checked.value) * unit
    values = (np.where(checked.finite, checked.impedance, value) / value)[:, rest]
    means = np.array([quarter.mean(axis=0) for quarter in np.array_split(values.real, 4)])
    changes = (means[:, None] - means[None]).reshape(16, -1)
    common = np.median(changes, axis=1)
    noise_std = np.maximum(noise[rest] * np.sqrt(2 * 4 / len(values)), np.finfo(float).eps)
    beside = changes - common[:, None]
    touched = np.sqrt((beside**2).mean(axis=1)) > TOUCHED
    touched &= ((beside / noise_std) ** 2).mean(axis=1) > SIGNIFICANT
    if not touched.any() and np.abs(common).max() <= max(MOVED, 3.0 * np.median(noise_std)):
        return
    largest = np.abs(changes).max(axis=0)
    moved = np.zeros_like(rest)
    moved[rest] = largest > np.maximum(MOVED, SIGNIFICANT * noise_std)
    electrodes, others = electrodes_at_fault(moved, checked.protocol)
    text = f"values changed by up to {100 * float(largest.max()):.2g} % during the check: "
    if len(electrodes) == 1 and not others:
        (e,) = electrodes
        text += f"the contact of electrode {e} is loose, press its wire into the gel, check plug "
        yield Finding(FindingKind.MOVED, (e,), channel_numbers(moved), f"{text}{e}")
        return
    text += "lay the sensor flat, leave it untouched, let it settle, and check again"
    yield Finding(FindingKind.MOVED, (), channel_numbers(moved), text)
