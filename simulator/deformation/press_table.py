"""Table of presses of one indenter on one unbounded stack."""

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, PPoly

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.deformation.dents import DEGREE, Dents, PlacedDent, TabulatedDent
from eitskin.simulator.deformation.sensor_grid import OWN_GRID, SensorGrid, StackGrid
from eitskin.simulator.deformation.solution_store import Arrays, Problem, Report, load_or_solve
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress
from eitskin.simulator.mechanics.layer_stack import Indentation, Mechanics, Stack
from eitskin.simulator.mechanics.load_stepping import SolidError
from eitskin.simulator.scene.indenters import Cylinder, Footprint, Indenter
from eitskin.simulator.scene.scene import Touch

Array = NDArray[np.float64]

# Version of the tables: raise it whenever presses are solved or tabulated in another way.
_VERSION = 3
# Everything is solved at one scale: a layer this thick [m], of this shear modulus [Pa].
_THICKNESS, _MODULUS = 0.005, 20e3
_SAMPLES = 65  # of the indenter's profile, which identify the indenter
_DEPTHS = 18
_MAX_DEPTH = 0.6  # of the thickness of the stack
# Depths are spaced like k^1.5, since forces and dents grow about like depth to the power 1 to 1.5.
_SPACING = 1.5
_MIN_DEPTHS = 4  # depths of a table
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
        thinnings: thinnings of the layer on the axis, (n,).
        energies: isochoric strain energy in the layer and in the whole stack, (n, 2) [J].
        thickness: thickness of the undeformed layer, () [m].
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

    def dent_from_force(self, force: float) -> TabulatedDent:
        """Dent of a press with `force` [N].

        Raises ConfigurationError for a force that is not positive, or beyond the table.
        """
        if not 0.0 < force <= self.largest_force:
            raise ConfigurationError(
                f"force must be above 0 and at most {self.largest_force:.3g} N, where the layer is "
                f"pressed to {1 - self.thinnings[-1]:.0%} of its thickness, got {force:g} N"
            )
        if force < self.forces[1]:
            return self._shallow_dent(force / float(self.forces[1]))
        scaled_depth = _depth_interpolation(self).forces.solve(force, extrapolate=False)[0]
        return self._dent(force, float(scaled_depth))

    def dent_from_depth(self, depth: float) -> TabulatedDent:
        """Dent of a press to `depth` [m]; raises ConfigurationError like `dent_from_force`."""
        if not 0.0 < depth <= self.depths[-1]:
            raise ConfigurationError(
                f"depth must be above 0 and at most {self.depths[-1]:.3g} m, where the layer is "
                f"pressed to {1 - self.thinnings[-1]:.0%} of its thickness, got {depth:g} m"
            )
        if depth < self.depths[1]:
            part = depth / float(self.depths[1])
            return self._shallow_dent(part ** (1.0 / self._power("depths")))
        scaled_depth = float((depth / self.depths[-1]) ** (1.0 / _SPACING))
        return self._dent(float(_depth_interpolation(self).forces(scaled_depth)), scaled_depth)

    def stretch_heights(self, factor: float) -> "PressTable":
        """Table with all heights multiplied by `factor`, which preserves J and the forces."""
        scaled = {
            name: factor * getattr(self, name) for name in ("depths", "energies", "thickness")
        }
        return replace(self, **scaled, moved=self.moved * (1.0, factor))

    def rescale(self, length: float, modulus: float) -> "PressTable":
        """Table with all lengths and moduli multiplied."""
        names = ("depths", "contact_radii", "thickness", "knots", "moved")
        scale = dict.fromkeys(names, length) | dict.fromkeys(
            ("peak_pressures", "stressed"), modulus
        )
        scale |= {"forces": modulus * length**2, "energies": modulus * length**3}
        return replace(self, **{name: by * getattr(self, name) for name, by in scale.items()})

    def _power(self, name: str) -> float:
        """Power of the force by which a quantity rises between the two shallowest presses.

        A flat end touches as a whole at once, and sinks in proportion.
        """
        if self.contact_radii[0] > 0.0 and name != "peak_pressures":
            return 1.0 if name == "depths" else 0.0
        _, first, second = getattr(self, name)[:3]
        return float(np.log(second / first) / np.log(self.forces[2] / self.forces[1]))

    def _shallow_dent(self, part: float) -> TabulatedDent:
        """Dent by a part of the shallowest force, from which the layer moves in proportion.

        A spline from no press on has a wrong power: depths would be several times too small.
        """
        first = self._dent(
            float(self.forces[1]), float((self.depths[1] / self.depths[-1]) ** (1.0 / _SPACING))
        )
        return replace(
            first,
            force=part * first.force,
            depth=part ** self._power("depths") * first.depth,
            contact_radius=part ** self._power("contact_radii") * first.contact_radius,
            peak_pressure=part ** self._power("peak_pressures") * first.peak_pressure,
            thinning=part * first.thinning,
            profile=PPoly.construct_fast(part * first.profile.c, first.profile.x),
        )

    def _dent(self, force: float, scaled_depth: float) -> TabulatedDent:
        table = _depth_interpolation(self)
        radius, pressure, thinning, *_ = table.numbers(scaled_depth).tolist()
        *_, in_layer, in_all = table.numbers(scaled_depth, 1).tolist()
        u, *others = np.moveaxis(np.tensordot(table.weights(scaled_depth), table.fields, 1), -1, 0)
        size = float(self.knots[-1])
        odd, even = _piecewise(_relative(self.knots, size))
        pieces = np.stack([odd @ u, *(even @ other for other in others)], axis=-1)
        pieces /= (size ** np.arange(3, -1, -1))[:, None, None, None]
        return TabulatedDent(
            force=force,
            depth=float(self.depths[-1] * scaled_depth**_SPACING),
            contact_radius=radius,
            peak_pressure=pressure,
            thinning=thinning,
            share=in_layer / in_all,
            thickness=float(self.thickness),
            profile=PPoly.construct_fast(pieces, self.knots),
        )


class _OverDepth(NamedTuple):
    """Quantities over (depth / largest depth)^(1 / 1.5), in which all are smooth.

    Attributes:
        forces: spline.
        numbers: spline of radius, pressure, thinning and both energies.
        weights: spline of the weights of the tabulated depths.
        fields: fields of these, coefficients of u, w and the mean stress at the knots, (n, m, 6,
            3).
    """

    forces: CubicSpline
    numbers: CubicSpline
    weights: CubicSpline
    fields: Array


@lru_cache(maxsize=16)
def _depth_interpolation(table: PressTable) -> _OverDepth:
    scaled_depths = (table.depths / table.depths[-1]) ** (1.0 / _SPACING)
    numbers = (table.contact_radii, table.peak_pressures, table.thinnings, *table.energies.T)
    fields = np.concatenate([table.moved, table.stressed[..., None]], axis=-1)
    return _OverDepth(
        CubicSpline(scaled_depths, table.forces),
        CubicSpline(scaled_depths, np.stack(numbers, axis=1)),
        CubicSpline(scaled_depths, np.eye(len(scaled_depths))),
        fields,
    )


def _relative(knots: Array, size: float) -> tuple[float, ...]:
    """Knots over a size, rounded so that those of different sensors are equal."""
    return tuple((knots / size).round(12).tolist())


@lru_cache(maxsize=32)
def _piecewise(knots: tuple[float, ...]) -> tuple[Array, Array]:
    """Piecewise cubics through unit values at knots, of odd and of even functions, (4, m - 1, m).

    From the highest power; slopes are zero at the last knot, as those of even ones on the axis.
    """
    unit = np.eye(len(knots))
    odd, even = (
        CubicSpline(knots, unit, bc_type=(end, "clamped")).c for end in ("natural", "clamped")
    )
    return odd, even


@lru_cache(maxsize=16)
def press_table(
    design: SensorDesign, mechanics: Mechanics, indenter: Indenter, grid: SensorGrid = OWN_GRID
) -> PressTable:
    """Press table of a sensor and an indenter; the first time takes seconds to a minute.

    Raises ConfigurationError where not even shallow presses are carried.
    """
    weights = StackGrid.from_design(design, mechanics, grid).full_weights()
    found = [(load_press_table(stack, indenter), weight) for stack, weight in weights]
    if len(found) == 1:
        return found[0][0]
    return weighted_sum(
        [table.stretch_heights(design.thickness / float(table.thickness)) for table, _ in found],
        np.array([weight for _, weight in found]),
    )


def press_problems(
    design: SensorDesign, mechanics: Mechanics, indenter: Indenter, grid: SensorGrid = OWN_GRID
) -> list[Problem]:
    """Tables that `press_table` needs; each takes seconds to a minute. Footprints have none."""
    if isinstance(indenter, Footprint):
        return []
    weights = StackGrid.from_design(design, mechanics, grid).full_weights()
    return [_problem(stack, indenter) for stack, _ in weights]


def load_press_table(stack: Stack, indenter: Indenter) -> PressTable:
    """Table of the conductive layer of a stack."""
    table = load_or_solve(_problem(stack, indenter), _from_arrays)
    return table.rescale(*_scales(stack))


def _from_arrays(arrays: Arrays) -> PressTable:
    return PressTable(**arrays)


@lru_cache(maxsize=512)
def _problem(stack: Stack, indenter: Indenter) -> Problem:
    """Table of a stack and an indenter, described at the solved thickness and modulus."""
    length, modulus = _scales(stack)
    laws = [
        dataclasses.replace(sheet.law, shear_modulus=sheet.law.shear_modulus / modulus)
        for sheet in stack.sheets
    ]
    described = {
        "version": _VERSION,
        "sheets": [
            [sheet.thickness / length, type(law).__name__, *dataclasses.astuple(law)]
            for sheet, law in zip(stack.sheets, laws, strict=True)
        ],
        "bulk_ratio": stack.bulk_ratio,
        **indenter_samples(indenter, length),
    }
    return Problem("press", described, partial(_solve_arrays, stack, indenter))


def _solve_arrays(stack: Stack, indenter: Indenter, report: Report) -> Arrays:
    length, modulus = _scales(stack)
    table = solve_table(stack, stack.gel, indenter).rescale(1.0 / length, 1.0 / modulus)
    report(1, 1)
    return {field.name: getattr(table, field.name) for field in fields(PressTable)}


def _scales(stack: Stack) -> tuple[float, float]:
    """Thickness and modulus of the conductive layer relative to the solved ones."""
    layer = stack.sheets[stack.gel]
    return layer.thickness / _THICKNESS, layer.law.shear_modulus / _MODULUS


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
            found.append(press.to_depth(_MAX_DEPTH * thickness * part))
        except SolidError:
            if len(found) < _MIN_DEPTHS:
                raise
            break
    bottom, top = stack.levels[layer : layer + 2]
    knots = _knots(indenter.rims[1], top - bottom, found[-1].r[-1])
    fit = partial(_layer_coefficients, bottom, top, knots)
    moved = np.stack([fit(one.r, one.z, one.displacement) for one in found])
    stressed = np.stack(
        [fit(one.r[::2], one.z[::2], one.mean_stress[layer, ..., None]) for one in found]
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

    def sum_arrays(name: str) -> Array:
        arrays = [getattr(table, name)[:deep] for table in tables]
        if name in ("moved", "stressed"):
            arrays = [
                _interpolate_knots(array, table.knots, farthest.knots)
                for array, table in zip(arrays, tables, strict=True)
            ]
        return np.tensordot(weights, np.stack(arrays), axes=1)

    same = {"thickness": farthest.thickness, "knots": farthest.knots}
    parts = {
        field.name: sum_arrays(field.name) for field in fields(PressTable) if field.name not in same
    }
    return PressTable(**same, **parts)


def _interpolate_knots(values: Array, knots: Array, target_knots: Array) -> Array:
    """Values (n, m, ...) over knots (m,), zero beyond the last, interpolated to other knots."""
    if np.array_equal(knots, target_knots):
        return values
    size = float(knots[-1])
    matrix = _interpolation(_relative(knots, size), _relative(np.minimum(target_knots, size), size))
    knot_values = matrix @ values.reshape(*values.shape[:2], -1)
    return np.asarray(knot_values.reshape(len(values), len(target_knots), *values.shape[2:]))


@lru_cache(maxsize=32)
def _interpolation(knots: tuple[float, ...], target_knots: tuple[float, ...]) -> Array:
    """Matrix from values at knots to those of their spline at other knots."""
    return np.asarray(CubicSpline(knots, np.eye(len(knots)))(target_knots))


def _knots(radius: float, thickness: float, end: float) -> Array:
    """Distances from the axis, evenly spaced under the indenter and wider beyond."""
    spacing = _KNOT * thickness
    inside = np.arange(0.0, radius + thickness, spacing)
    beyond = [inside[-1]]
    while beyond[-1] < end - thickness:
        spacing = min((1.0 + _KNOT_GROWTH) * spacing, 0.5 * thickness)
        beyond.append(beyond[-1] + spacing)
    return np.concatenate([inside, beyond[1:], [end]])


def _layer_coefficients(
    bottom: float, top: float, knots: Array, r: Array, z: Array, values: Array
) -> Array:
    """Legendre coefficients over the height of a layer at the knots, (m, coefficients, k).

    Values (nr, nz, k) are at radii r (nr,) and heights z (nz,).
    """
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


def indenter_samples(indenter: Indenter, length: float = 1.0) -> dict[str, object]:
    """Numbers that identify an indenter, of lengths over `length`."""
    heights, slopes = _profile(indenter)
    return {
        "rims": [rim / length for rim in indenter.rims],
        "rough": indenter.rough,
        "heights": (heights / length).tolist(),
        "slopes": slopes,
    }


@lru_cache(maxsize=64)
def _profile(indenter: Indenter) -> tuple[Array, list[float]]:
    """Heights [m] and slopes of an indenter's profile."""
    heights, slopes, _ = indenter.profile(np.linspace(0.0, indenter.rims[1], _SAMPLES))
    return heights, slopes.tolist()


def sketched_dents(touches: Iterable[Touch], design: SensorDesign) -> Dents:
    """Superposed dents of the 15 mm cylinder on the reference sensor, stretched to a design.

    A sketch for drawings, of which nothing has to be solved; greater forces than those solved
    count as the largest.
    """
    table = press_table(SensorDesign.reference(), Mechanics(), Cylinder())
    table = table.stretch_heights(design.thickness / float(table.thickness))
    most = table.largest_force
    return Dents(
        tuple(PlacedDent(t.x, t.y, table.dent_from_force(min(t.force, most))) for t in touches)
    )
