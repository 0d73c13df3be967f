"""Conductivities as they are given, as checked entries of tensors."""

import warnings
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.bounds import LEAST, MOST
from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.kinematics import TENSOR_COLUMNS, TENSOR_ROWS
from eitskin.geometry.design.dispersion import Dispersion, resolve_conductivity

_MAX_JUMP = 1.5  # of a conductivity within a cell

Array = NDArray[np.float64]
Numbers = NDArray[np.inexact]
Field = Callable[[Array], ArrayLike]
Conductivity: TypeAlias = complex | Dispersion | Numbers | Field


def conductivity_entries(
    conductivity: Conductivity, points: Array, cells: int, frequency: float | None = None
) -> Numbers:
    """Conductivity in the form of `Assembly.matrices`, (cells, q or 1, 1 or 6) [S/m].

    Scalars, or entries xx, yy, zz, xy, xz, yz of tensors. Raises ConfigurationError for another
    shape, and where a scalar or tensor is not positive.

    Args:
        conductivity: conductivity as in `ForwardModel.impedance`.
        points: quadrature points of the cells, (cells, q, 3) [m].
        cells: number of cells.
        frequency: frequency of a conductivity that depends on it [Hz]; 40 kHz when omitted.
    """
    if isinstance(conductivity, Dispersion):
        conductivity = resolve_conductivity(conductivity, frequency)
    if callable(conductivity):
        value, shape = _numbers(conductivity(points)), points.shape[:-1]
        asked = f"from f(x) of x with shape {points.shape} of shape {shape}"
    else:
        value, shape = _numbers(conductivity), (cells, 1)
        value = value[:, None] if value.ndim else value
        asked = f"per cell of shape {shape[:1]}"
    if value.shape == shape or value.ndim == 0:
        entries = np.broadcast_to(value, shape)[..., None]
    elif value.shape == (*shape, 3, 3):
        entries = value[..., TENSOR_ROWS, TENSOR_COLUMNS]
    else:
        raise ConfigurationError(
            f"conductivity must be a scalar, or {asked}, with (3, 3) after it for tensors, got "
            f"shape {value.shape}"
        )
    if not _positive_definite(value.real, entries.real) or not _is_solvable(value, entries):
        raise ConfigurationError(
            "conductivity must be finite, symmetric and, in its real part, positive "
            f"everywhere, from {LEAST:g} to {MOST:g} S/m; entries on the diagonal are from "
            f"{entries[..., :3].min():g} to {entries[..., :3].max():g}"
        )
    return entries


def warn_of_edges(entries: Numbers) -> None:
    """Warn where scalars (cells, q, 1) jump within cells, which no element can follow."""
    if entries.shape[1] == 1 or entries.shape[2] > 1:
        return
    sizes = np.abs(entries[..., 0])
    jumps = sizes.max(axis=1) / sizes.min(axis=1)
    cells = int((jumps > _MAX_JUMP).sum())
    if cells:
        warnings.warn(
            f"the conductivity changes by up to a factor of {jumps.max():.3g} in {cells} cells, "
            "so that changes of the measurements may be several percent off, or more; "
            "give its edges as ForwardModel(design, inclusions=[Inclusion(...)]) or by a mesh",
            stacklevel=4,
        )


def _numbers(values: ArrayLike) -> Numbers:
    """Real or complex numbers in double precision; raises ConfigurationError for others."""
    try:
        value = np.asarray(values)
        kind = np.complex128 if np.iscomplexobj(value) else np.float64
        return np.asarray(value, dtype=kind)
    except (TypeError, ValueError) as error:
        raise ConfigurationError(f"conductivity must be numbers in S/m: {error}") from error


def _is_solvable(value: Numbers, entries: Numbers) -> bool:
    """Whether imaginary parts are symmetric, and finite as those of what can be solved with."""
    if not np.iscomplexobj(value):
        return True
    symmetric = entries.shape[-1] == 1 or bool(
        np.allclose(value.imag, np.swapaxes(value.imag, -1, -2), rtol=1e-9, atol=0.0)
    )
    return symmetric and bool(np.all(np.abs(entries.imag) <= MOST))


def _positive_definite(tensors: Array, entries: Array) -> bool:
    """Whether all scalars, or all tensors of these entries, are positive (Sylvester's minors).

    None on their diagonals may be beyond the bounds of what a matrix of them can be solved with.
    """
    diagonal = entries[..., :3]
    if not np.all((diagonal >= LEAST) & (diagonal <= MOST)):
        return False
    if entries.shape[-1] == 1:
        return True
    xx, yy, zz, xy, xz, yz = np.moveaxis(entries, -1, 0)
    second = xx * yy - xy**2
    third = second * zz - xx * yz**2 - yy * xz**2 + 2.0 * xy * xz * yz
    # NaN fails every comparison and is refused, too.
    return all(bool(np.all((m > 0.0) & np.isfinite(m))) for m in (second, third)) and all(
        bool(np.allclose(tensors[..., a, b], tensors[..., b, a], rtol=1e-9, atol=0.0))
        for a, b in ((0, 1), (0, 2), (1, 2))
    )
