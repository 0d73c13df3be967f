"""Table of presses of one indenter on one stack: solved over depth, then interpolated."""

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
from eitskin.simulator.presses.tabulated_dent import DEGREE, TabulatedDent
from eitskin.simulator.scene.indenters import Indenter

Array = NDArray[np.float64]

_DEPTHS = 18
_DEEPEST = 0.6  # of the thickness of the stack
# Depths are spaced like k^1.5, since forces and dents grow about like depth to the power 1 to 1.5.
_SPACING = 1.5
_FEWEST = 4  # depths of a table
_CELL = 1.0 / 40.0  # finest, of the radius of the indenter
_KNOT = 0.1  # spacing of radial knots near the indenter, over the layer's thickness
_KNOT_GROWTH = 0.1
_FIRST = 0.4  # of the first depth: an additional shallow press, for accuracy
_NEGLIGIBLE = 1e-4  # displacements over the depth at which a dent ends


@dataclass(frozen=True, slots=True, eq=False)
class PressTable:
    """Presses of one indenter on one stack, from no press to the deepest solved one.

    Attributes:
        depths: rising from 0, (n,) [m].
        forces: (n,) [N].
        contact_radii: (n,) [m].
        peak_pressures: (n,) [Pa].
        thinnings: of the layer on the axis, (n,).
        energies: isochoric strain energy in the layer and in the whole stack, (n, 2) [J].
        thickness: of the undeformed layer, () [m].
        knots: distances from the axis, (m,) [m].
        moved: displacements u and w at the knots as coefficients of Legendre polynomials over the
            height of the layer, (n, m, coefficients, 2) [m].
        stressed: mean stress at the knots likewise, (n, m, coefficients) [Pa].
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
        """Largest solved force [N]."""
        return float(self.forces[-1])

    def at_force(self, force: float) -> TabulatedDent:
        """Dent of a press with `force` [N].

        Raises ConfigurationError for a force that is not positive, or beyond the table.
        """
        if not 0.0 < force <= self.largest_force:
            raise ConfigurationError(
                f"force must be above 0 and at most {self.largest_force:.3g} N, where the layer is "
                f"pressed to {1 - self.thinnings[-1]:.0%} of its thickness, got {force:g} N"
            )
        scaled_depth = _over_depth(self).forces.solve(force, extrapolate=False)[0]
        return self._dent(force, float(scaled_depth))

    def at_depth(self, depth: float) -> TabulatedDent:
        """Dent of a press to `depth` [m]; raises ConfigurationError like `at_force`."""
        if not 0.0 < depth <= self.depths[-1]:
            raise ConfigurationError(
                f"depth must be above 0 and at most {self.depths[-1]:.3g} m, where the layer is "
                f"pressed to {1 - self.thinnings[-1]:.0%} of its thickness, got {depth:g} m"
            )
        scaled_depth = float((depth / self.depths[-1]) ** (1.0 / _SPACING))
        return self._dent(float(_over_depth(self).forces(scaled_depth)), scaled_depth)

    def stretched(self, factor: float) -> "PressTable":
        """Table with all heights multiplied by `factor`, which preserves J and the forces."""
        scaled = {
            name: factor * getattr(self, name) for name in ("depths", "energies", "thickness")
        }
        return replace(self, **scaled, moved=self.moved * (1.0, factor))

    def _dent(self, force: float, scaled_depth: float) -> TabulatedDent:
        table = _over_depth(self)
        radius, pressure, thinning = table.numbers(scaled_depth)
        in_layer, in_all = table.energies(scaled_depth, 1)
        return TabulatedDent(
            force=force,
            depth=float(self.depths[-1] * scaled_depth**_SPACING),
            contact_radius=float(radius),
            peak_pressure=float(pressure),
            thinning=float(thinning),
            share=float(in_layer / in_all),
            thickness=float(self.thickness),
            profile=PPoly(table.profiles(scaled_depth), self.knots),
        )


class _OverDepth(NamedTuple):
    """Splines over (depth / largest depth)^(1 / 1.5), in which all quantities are smooth."""

    forces: CubicSpline
    numbers: CubicSpline
    energies: CubicSpline
    profiles: CubicSpline


@lru_cache(maxsize=16)
def _over_depth(table: PressTable) -> _OverDepth:
    scaled_depths = (table.depths / table.depths[-1]) ** (1.0 / _SPACING)
    # On the axis u is odd, w and the stress are even; at the last knot all slopes are zero.
    fields = np.concatenate([table.moved, table.stressed[..., None]], axis=-1)
    profiles = [
        CubicSpline(table.knots, fields[..., k], axis=1, bc_type=(end, "clamped")).c
        for k, end in enumerate(("natural", "clamped", "clamped"))
    ]
    numbers = (table.contact_radii, table.peak_pressures, table.thinnings)
    return _OverDepth(
        CubicSpline(scaled_depths, table.forces),
        CubicSpline(scaled_depths, np.stack(numbers, axis=1)),
        CubicSpline(scaled_depths, table.energies),
        CubicSpline(scaled_depths, np.moveaxis(np.stack(profiles, axis=-1), 2, 0)),
    )


def solve_table(stack: Stack, layer: int, indenter: Indenter) -> PressTable:
    """Solve presses of rising depth, to 0.6 of the thickness or the last equilibrium.

    Args:
        stack: the layers.
        layer: number of the sheet whose deformation is tabulated.
        indenter: rigid body that presses.

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


def weighted_sum(tables: list[PressTable], weights: Array) -> PressTable:
    """Weighted sum of tables of one thickness, up to the depths of the shallowest."""
    deep = min(len(table.depths) for table in tables)
    farthest = max(tables, key=lambda table: float(table.knots[-1]))

    def summed(name: str) -> Array:
        arrays = [getattr(table, name)[:deep] for table in tables]
        if name in ("moved", "stressed"):
            arrays = [
                _at_knots(array, table.knots, farthest.knots)
                for array, table in zip(arrays, tables, strict=True)
            ]
        return np.tensordot(weights, np.stack(arrays), axes=1)

    same = {"thickness": farthest.thickness, "knots": farthest.knots}
    parts = {
        field.name: summed(field.name) for field in fields(PressTable) if field.name not in same
    }
    return PressTable(**same, **parts)


def _at_knots(values: Array, knots: Array, wanted: Array) -> Array:
    """Values (n, m, ...) over knots (m,), zero beyond the last, interpolated to other knots."""
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

    `field` holds radii r (nr,), heights z (nz,) and values (nr, nz, k).
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
    """Values preceded by the value `first` of no press."""
    array = np.asarray(values, dtype=np.float64)
    return np.concatenate([np.full_like(array[:1], first), array])
