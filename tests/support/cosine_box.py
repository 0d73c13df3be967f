"""Box with electrodes on its sides by cosine modes: impedances without finite elements.

The potential of a current through a side is a sum of cosines along the side, each with its
hyperbolic function across the box. Current densities of the electrodes are Legendre polynomials
along and upwards, whose cosine coefficients are spherical Bessel functions; the complete electrode
model is tested with the same polynomials (Galerkin). Six by six polynomials and waves of 0.1 mm are
good to 5e-5 for electrodes of 1 to 4 mm height at 1e-3 ohm m2 and 1 S/m.
"""

import numpy as np
from numpy.polynomial import legendre
from scipy.special import spherical_jn

_POINTS = 30  # of quadrature along an electrode on another pair of sides


def box_impedance(design, polynomials=8, spacing=5e-5):
    """Impedance matrix of a rectangle with electrodes on the side, (electrodes, electrodes) [ohm].

    Args:
        design: the sensor, of real conductivity and contact impedances.
        polynomials: Legendre polynomials each way on an electrode.
        spacing: half the shortest wave [m].
    """
    sides = [_Side(design, each, polynomials, spacing) for each in design.electrodes]
    count, size = len(sides), polynomials**2
    matrix, areas = np.zeros((count, size, count, size)), np.zeros((count, size, count))
    for i, one in enumerate(sides):
        areas[i, 0, i] = one.width * one.height
        for j, other in enumerate(sides):
            matrix[i, :, j] = one.coupling(other) / design.conductivity
        matrix[i, :, i] += one.contact * np.diag(one.mass)
    areas = areas.reshape(count * size, count)
    admittance = areas.T @ np.linalg.solve(matrix.reshape(2 * (count * size,)), areas)
    zero_mean = np.eye(count) - 1.0 / count
    return zero_mean @ np.linalg.inv(admittance) @ zero_mean


class _Side:
    """An electrode with the modes of the side that carries it."""

    def __init__(self, design, electrode, polynomials, spacing):
        box = np.array([design.outline.length, design.outline.width])
        place = np.array([electrode.x, electrode.y])
        on_x = np.isclose(place[0], 0.0) or np.isclose(place[0], box[0])
        self.axis = 0 if on_x else 1  # across the side
        self.is_far = bool(np.isclose(place[self.axis], box[self.axis]))
        self.across, self.extent = box[self.axis], box[1 - self.axis]
        self.thickness, self.contact = design.thickness, electrode.contact_impedance
        self.middle, self.width = place[1 - self.axis], electrode.width
        self.height = electrode.height or design.thickness
        self.z = 0.5 * design.thickness if electrode.z is None else electrode.z
        self.polynomials = polynomials
        shares = 1.0 / (2.0 * np.arange(polynomials) + 1.0)
        self.mass = np.outer(self.width * shares, self.height * shares).ravel()
        along = np.arange(int(self.extent / spacing))
        up = np.arange(int(self.thickness / spacing))
        self.along = _coefficients(polynomials, along, self.extent, self.middle, self.width)
        self.up = _coefficients(polynomials, up, self.thickness, self.z, self.height)
        self.rate = np.pi * np.hypot(along[:, None] / self.extent, up / self.thickness)
        norm = np.outer(np.where(along, 2.0, 1.0), np.where(up, 2.0, 1.0))
        self.norm = norm / (self.extent * self.thickness)

    def profile(self, distance):
        """Potential of each mode at distances from the side, (along, up, distances) [m]."""
        rate, across = self.rate[..., None], self.across
        with np.errstate(divide="ignore", invalid="ignore"):
            both = np.exp(-rate * distance) + np.exp(-rate * (2.0 * across - distance))
            values = both / (rate * -np.expm1(-2.0 * rate * across))
        # The uniform current leaves evenly through the box.
        values[0, 0] = across / 3.0 - distance + distance**2 / (2.0 * across)
        return values * self.norm[..., None]

    def coupling(self, other):
        """Integrals of own polynomials times potentials of the other's, (own, other)."""
        size = 2 * (self.polynomials**2,)
        if self.axis == other.axis:
            distance = 0.0 if self.is_far == other.is_far else self.across
            kernel = self.profile(np.array([distance]))[..., 0]
            up = (self.up[:, None] * other.up) @ kernel.T
            parts = np.einsum("pm,rm,qsm->pqrs", self.along, other.along, up, optimize=True)
            return parts.reshape(size)
        nodes, weights = legendre.leggauss(_POINTS)
        place = self.middle + 0.5 * self.width * nodes
        distance = other.across - place if other.is_far else place
        signs = (-1.0) ** np.arange(other.along.shape[1]) if self.is_far else 1.0
        values = legendre.legvander(nodes, self.polynomials - 1)
        own = other.profile(distance) @ (0.5 * self.width * weights[:, None] * values)
        near = min(200, own.shape[0])  # waves along the side fall off across it
        return np.einsum(
            "mkp,qk,rm,sk->pqrs",
            own[:near],
            self.up,
            (other.along * signs)[:, :near],
            other.up,
            optimize=True,
        ).reshape(size)


def _coefficients(polynomials, modes, extent, middle, width):
    """Integrals of Legendre polynomials on an interval times cosines, (polynomials, modes)."""
    half, phase = 0.5 * np.pi * modes * width / extent, np.pi * modes * middle / extent
    return np.stack(
        [
            width * np.real(np.exp(1j * phase) * 1j**n) * spherical_jn(n, half)
            for n in range(polynomials)
        ]
    )
