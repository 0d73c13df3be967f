"""Presses of one indenter on one stack: solved over depth once, then interpolated."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, PPoly

from eitskin.errors import ConfigurationError
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress, Indentation
from eitskin.simulator.mechanics.layer_stack import Stack
from eitskin.simulator.mechanics.load_stepping import SolidError
from eitskin.simulator.mechanics.tabulated_dent import DEGREE, TabulatedDent
from eitskin.simulator.scene.indenters import Indenter

Array = NDArray[np.float64]

_DEPTHS = 18
_DEEPEST = 0.6  # of the thickness of the stack
# Depths are spaced like k^1.5, since forces and dents grow about like depth to the power 1 to 1.5.
_SPACING = 1.5
_FEWEST = 4  # depths that a table needs
_CELL = 1.0 / 20.0  # finest, of the radius of the indenter
_KNOT = 0.1  # spacing over the layer's thickness near the indenter
_KNOT_GROWTH = 0.1
_FIRST = 0.4  # of the first depth, below which the table would be poor
_NEGLIGIBLE = 1e-4  # displacements at which a dent ends, of the depth


@dataclass(frozen=True, slots=True, eq=False)
class PressTable:
    """Presses of one indenter on one stack, from none to the deepest that was solved.

    Attributes:
        depths: rising from 0, (n,) [m].
        forces: (n,) [N].
        contact_radii: (n,) [m].
        peak_pressures: (n,) [Pa].
        thinnings: of the layer on the axis, (n,).
        energies: of changes of shape, (n, 2), in the layer and in all of the stack [J].
        thickness: of the undeformed layer, () [m].
        knots: distances from the axis, (m,) [m].
        moved: u and w at the knots as coefficients of Legendre polynomials over the height of the
            layer, (n, m, coefficients, 2) [m].
        stressed: mean stress likewise, (n, m, coefficients) [Pa].
    """

    depths: Array
    forces: Array
    contact_radii: Array
    peak_pressures: Array
    thinnings: Array
    energies: Array
    thickness: Array
    knots: Array
    moved: Array
    stressed: Array

    @property
    def largest_force(self) -> float:
        """The force up to which presses were solved [N]."""
        return float(self.forces[-1])

    def at_force(self, force: float) -> TabulatedDent:
        """The dent of a press with `force` [N].

        Raises ConfigurationError for a force that is not positive, or beyond the table.
        """
        if not 0.0 < force <= self.largest_force:
            raise ConfigurationError(
                f"force must be above 0 and at most {self.largest_force:.3g} N, where the layer is "
                f"pressed to {1 - self.thinnings[-1]:.0%} of its thickness, got {force:g} N"
            )
        place = _over_depth(self).forces.solve(force, extrapolate=False)[0]
        return self._dent(force, float(place))

    def at_depth(self, depth: float) -> TabulatedDent:
        """The dent of a press to `depth` [m]; raises ConfigurationError like `at_force`."""
        if not 0.0 < depth <= self.depths[-1]:
            raise ConfigurationError(
                f"depth must be above 0 and at most {self.depths[-1]:.3g} m, where the layer is "
                f"pressed to {1 - self.thinnings[-1]:.0%} of its thickness, got {depth:g} m"
            )
        place = float((depth / self.depths[-1]) ** (1.0 / _SPACING))
        return self._dent(float(_over_depth(self).forces(place)), place)

    def stretched(self, factor: float) -> "PressTable":
        """These presses with all heights times `factor`, which keeps volumes and forces."""
        scaled = {
            name: factor * getattr(self, name) for name in ("depths", "energies", "thickness")
        }
        return replace(self, **scaled, moved=self.moved * (1.0, factor))

    def _dent(self, force: float, place: float) -> TabulatedDent:
        table = _over_depth(self)
        radius, pressure, thinning = table.numbers(place)
        in_layer, in_all = table.energies(place, 1)
        return TabulatedDent(
            force=force,
            depth=float(self.depths[-1] * place**_SPACING),
            contact_radius=float(radius),
            peak_pressure=float(pressure),
            thinning=float(thinning),
            share=float(in_layer / in_all),
            thickness=float(self.thickness),
            profile=PPoly(table.profiles(place), self.knots),
        )


class _OverDepth(NamedTuple):
    """Splines over the place of a depth on a scale from 0 to 1, on which all grows smoothly."""

    forces: CubicSpline
    numbers: CubicSpline
    energies: CubicSpline
    profiles: CubicSpline


@lru_cache(maxsize=64)
def _over_depth(kernel: PressTable) -> _OverDepth:
    places = (kernel.depths / kernel.depths[-1]) ** (1.0 / _SPACING)
    # On the axis u is odd, w and the stress are even; at the last knot all end level.
    fields = np.concatenate([kernel.moved, kernel.stressed[..., None]], axis=-1)
    profiles = [
        CubicSpline(kernel.knots, fields[..., k], axis=1, bc_type=(end, "clamped")).c
        for k, end in enumerate(("natural", "clamped", "clamped"))
    ]
    numbers = (kernel.contact_radii, kernel.peak_pressures, kernel.thinnings)
    return _OverDepth(
        CubicSpline(places, kernel.forces),
        CubicSpline(places, np.stack(numbers, axis=1)),
        CubicSpline(places, kernel.energies),
        CubicSpline(places, np.moveaxis(np.stack(profiles, axis=-1), 2, 0)),
    )


def solved(stack: Stack, layer: int, indenter: Indenter) -> PressTable:
    """Press deeper and deeper, as far as there is an equilibrium or to 0.6 of the thickness.

    Args:
        stack: what is pressed.
        layer: number of the sheet whose deformation is kept.
        indenter: what presses.

    Raises SolidError where not even shallow presses are carried.
    """
    thickness = stack.levels[-1]
    press = AxisymmetricPress(stack, indenter, finest=_CELL * indenter.rims[1])
    found: list[Indentation] = []
    for part in (np.append(_FIRST, np.arange(1, _DEPTHS + 1)) / _DEPTHS) ** _SPACING:
        try:
            found.append(press.to_depth(_DEEPEST * thickness * part))
        except SolidError:
            if len(found) < _FEWEST:
                raise
            break
    bottom, top = stack.levels[layer : layer + 2]
    knots = _knots(indenter.rims[1], top - bottom, found[-1].r[-1])
    moved, stressed = (
        np.stack([_over_layer(each(one), bottom, top, knots) for one in found])
        for each in (_displacements, partial(_mean_stresses, layer))
    )
    felt = np.abs(moved).max(axis=(2, 3)) > _NEGLIGIBLE * np.array([[one.depth] for one in found])
    end = min(len(knots), int(np.flatnonzero(felt.any(axis=0))[-1]) + 2)
    moved, stressed = moved[:, :end], stressed[:, :end, :, 0]
    moved[:, -1] = stressed[:, -1] = 0.0
    return PressTable(
        depths=_from_none([one.depth for one in found]),
        forces=_from_none([one.force for one in found]),
        contact_radii=_from_none([one.contact_radius for one in found], indenter.rims[0]),
        peak_pressures=_from_none([one.pressure.max() for one in found]),
        thinnings=_from_none([one.thinning(layer) for one in found]),
        energies=_from_none([(one.energies[layer], one.energies.sum()) for one in found]),
        thickness=np.array(top - bottom),
        knots=knots[:end],
        moved=_from_none(moved),
        stressed=_from_none(stressed),
    )


def combined(kernels: list[PressTable], weights: Array) -> PressTable:
    """The weighted sum of kernels of one thickness, to depths that all reach."""
    deep = min(len(kernel.depths) for kernel in kernels)
    farthest = max(kernels, key=lambda kernel: float(kernel.knots[-1]))

    def summed(name: str) -> Array:
        arrays = [getattr(kernel, name)[:deep] for kernel in kernels]
        if name in ("moved", "stressed"):
            arrays = [
                _at_knots(array, kernel.knots, farthest.knots)
                for array, kernel in zip(arrays, kernels, strict=True)
            ]
        return np.tensordot(weights, np.stack(arrays), axes=1)

    same = {"thickness": farthest.thickness, "knots": farthest.knots}
    parts = {
        field.name: summed(field.name) for field in fields(PressTable) if field.name not in same
    }
    return PressTable(**same, **parts)


def _at_knots(values: Array, knots: Array, wanted: Array) -> Array:
    """Values (n, m, ...) over knots (m,), zero at the last and beyond, at other knots."""
    if np.array_equal(knots, wanted):
        return values
    return np.asarray(CubicSpline(knots, values, axis=1)(np.minimum(wanted, knots[-1])))


def _knots(radius: float, thickness: float, end: float) -> Array:
    """Distances from the axis, evenly spaced under the indenter and wider beyond."""
    spacing = _KNOT * thickness
    inside = np.arange(0.0, radius + thickness, spacing)
    beyond = [inside[-1]]
    while beyond[-1] < end - thickness:
        spacing = min((1.0 + _KNOT_GROWTH) * spacing, 0.5 * thickness)
        beyond.append(beyond[-1] + spacing)
    return np.concatenate([inside, beyond[1:], [end]])


def _displacements(found: Indentation) -> tuple[Array, Array, Array]:
    return found.r, found.z, found.displacement


def _mean_stresses(layer: int, found: Indentation) -> tuple[Array, Array, Array]:
    return found.r[::2], found.z[::2], found.mean_stress[layer, ..., None]


def _over_layer(
    field: tuple[Array, Array, Array], bottom: float, top: float, knots: Array
) -> Array:
    """Legendre coefficients over the height of a layer at the knots, (m, coefficients, k).

    `field` holds places r (nr,), heights z (nz,) and values there, (nr, nz, k).
    """
    r, z, values = field
    inside = (z > bottom - 1e-9) & (z < top + 1e-9)
    heights = 2.0 * (z[inside] - bottom) / (top - bottom) - 1.0
    along = CubicSpline(r, values[:, inside])(knots).swapaxes(0, 1)
    degree = min(DEGREE, len(heights) - 1)
    fit = np.zeros((DEGREE + 1, along[0].size))
    fit[: degree + 1] = legendre.legfit(heights, along.reshape(len(heights), -1), degree)
    return fit.reshape(DEGREE + 1, len(knots), -1).swapaxes(0, 1)


def _from_none(values: Sequence[object] | Array, first: float = 0.0) -> Array:
    """The values after one for no press at all."""
    array = np.asarray(values, dtype=np.float64)
    return np.concatenate([np.full_like(array[:1], first), array])
