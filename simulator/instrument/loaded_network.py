"""Circuit of a four-terminal meter on a sensor: potentials under loads and leaks to ground.

The sensor is the network between its electrodes, floating: with currents I into the electrodes that
sum to zero the potentials are U = Z I + c, with the impedance matrix Z and one potential c common
to all. Each electrode hangs on a lead of series resistance R_k and, at the meter's end of the lead,
on an admittance Y_k to ground. A balanced source sends J = +1 A into source and -1 A into sink.
Kirchhoff's current law at the meter's ends, I = J - Y V, gives

    (1 + (Z + R) Y) V - c = (Z + R) J,    sum(Y V) = 0.

Without any admittance the sensor floats; ground is then the mean of the electrode potentials.
"""

import numpy as np
from numpy.typing import NDArray

from eitskin.protocol import Protocol

Complex = NDArray[np.complex128]


def role_potentials(
    impedance: NDArray[np.inexact], protocol: Protocol, admittance: Complex, leads: Complex
) -> Complex:
    """Potentials of source, sink, sense+ and sense- against ground per unit current [ohm].

    The shape is (4, ..., measurements).

    Args:
        impedance: electrode impedance matrices Z, (..., electrodes, electrodes) [ohm].
        protocol: drive and sense electrodes of each measurement.
        admittance: to ground, of each electrode during each measurement, (measurements, electrodes)
            [S].
        leads: resistance in series with each electrode, (electrodes,) [ohm].
    """
    system, right = _equations(impedance, protocol, admittance, leads)
    V = np.linalg.solve(system, right)[..., 0]
    rows = np.arange(len(protocol))
    by_role = [V[..., rows, electrodes] for electrodes in np.array(protocol.table).T]
    return np.array(by_role, np.complex128)


def potential_derivatives(
    impedance: NDArray[np.inexact],
    protocol: Protocol,
    admittance: Complex,
    leads: Complex,
    weights: tuple[complex, complex],
) -> tuple[Complex, Complex]:
    """Derivatives of a weighted sum of the sensed potentials, by the adjoint method.

    Returns the derivatives by the admittance [ohm/S] and by the lead [1] of each electrode in each
    measurement, (measurements, electrodes) both. Where all admittances of a measurement are zero,
    ground is held at the mean of the electrodes.

    Args:
        impedance: electrode impedance matrix Z, (electrodes, electrodes) [ohm].
        protocol, admittance, leads: as for `role_potentials`.
        weights: of the potentials of sense+ and sense-.
    """
    n, (source, sink, plus, minus) = protocol.n_electrodes, np.array(protocol.table).T
    system, right = _equations(impedance, protocol, admittance, leads)
    rows, sensed = np.arange(len(protocol)), np.zeros((len(protocol), n + 1, 1), np.complex128)
    sensed[rows, plus, 0], sensed[rows, minus, 0] = weights
    V = np.linalg.solve(system, right)[:, :n, 0]
    adjoint = np.linalg.solve(np.swapaxes(system, 1, 2), sensed)[..., 0]
    total = admittance.sum(axis=1, keepdims=True)
    grounded = np.where(total == 0.0, 0.0, adjoint[:, n:] / np.where(total == 0.0, 1.0, total))
    back = adjoint[:, :n] @ (np.asarray(impedance) + np.diag(leads)) + grounded
    current = -admittance * V
    current[rows, source] += 1.0
    current[rows, sink] -= 1.0
    return (-back * V).astype(complex), (adjoint[:, :n] * current).astype(complex)


def _equations(
    impedance: NDArray[np.inexact], protocol: Protocol, admittance: Complex, leads: Complex
) -> tuple[NDArray[np.inexact], NDArray[np.inexact]]:
    """Matrices (..., measurements, n + 1, n + 1) and right sides of V and c."""
    n = protocol.n_electrodes
    drive, _ = protocol.patterns()
    Z = np.asarray(impedance) + np.diag(_real_where_possible(leads))
    Y = _real_where_possible(admittance)
    total = Y.sum(axis=-1, keepdims=True)
    floating = total == 0.0
    # One row per measurement: weights of the potentials in the definition of ground.
    ground = np.where(floating, 1.0 / n, Y / np.where(floating, 1.0, total))
    kind = np.result_type(Z, Y, np.float64)
    system = np.zeros((*Z.shape[:-2], len(protocol), n + 1, n + 1), kind)
    system[..., :n, :n] = np.eye(n) + Z[..., None, :, :] * Y[:, None, :]
    system[..., :n, n] = -1.0
    system[..., n, :n] = ground
    right = np.zeros((*system.shape[:-1], 1), kind)
    right[..., :n, 0] = np.swapaxes(Z @ drive, -1, -2)
    return system, right


def _real_where_possible(values: Complex) -> NDArray[np.inexact]:
    return values if values.imag.any() else values.real
