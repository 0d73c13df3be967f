"""Contact of the axisymmetric press, which the reference prescribes."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress
from eitskin.simulator.mechanics.layer_stack import Stack
from eitskin.simulator.scene.indenters import Cylinder, Sphere

Array = NDArray[np.float64]

_CELL, _STEPS = 1.0 / 60.0, 24  # finest of the axisymmetric press, over the radius; its steps
_GRID = 241  # radii and heights of the initial guess


@dataclass(frozen=True, slots=True, eq=False)
class ContactProfile:
    """Displacement of the contact of the axisymmetric press, relative to the indenter.

    Attributes:
        radius: undeformed radius where contact ends [mm].
        radii: rising from 0 [mm].
        displacement: outwards, and upwards from the indenter's lowest point, (n, 2) [mm].
        depth: of the axisymmetric press [mm].
        field: outwards and upwards, on an even grid of radii and heights, (nr, nz, 2) [mm].
        extent: last radius and height of the grid [mm].
    """

    radius: float
    radii: Array
    displacement: Array
    depth: float
    field: Array
    extent: tuple[float, float]


@lru_cache(maxsize=16)
def contact_profile(stack: Stack, indenter: Cylinder | Sphere, force: float) -> ContactProfile:
    """Contact profile of the axisymmetric press at a force [N]."""
    press = AxisymmetricPress(stack, indenter, finest=_CELL * indenter.rims[1])
    # Small steps, since a rough indenter sticks to newly touched points only after each.
    for part in (np.arange(1, _STEPS + 1) / _STEPS) ** 1.5:
        found = press.to_force(part * force)
    pressure = press.contact.nominal_pressure(press.unknowns).ravel()
    r = press.contact.points[..., 0].ravel()
    order = np.argsort(r)
    last = np.flatnonzero(pressure[order] > 0.0)[-1]
    top = found.displacement[:, -1].copy()
    top[:, 1] += found.depth
    radius = 1e3 * float(r[order][last : last + 2].mean())
    r, z = (np.linspace(0.0, line[-1], _GRID) for line in (found.r, found.z))
    even = RegularGridInterpolator((found.r, found.z), 1e3 * found.displacement)
    return ContactProfile(
        radius=radius,
        radii=1e3 * found.r,
        displacement=1e3 * top,
        depth=1e3 * found.depth,
        field=even(tuple(np.meshgrid(r, z, indexing="ij"))),
        extent=(1e3 * float(r[-1]), 1e3 * float(z[-1])),
    )
