"""The linear system of one scene, written so that no contact impedance makes it cancel.

With u = w + E U, where column l of E is a function that is one on electrode l and none or zero,
the weak form of `assembly` becomes

    A w = B U,   I = D U - B^T w,   A = K + contact

in two ways per electrode:

    E_l = 0:                B_l = int phi / z_l,    D_ll = int 1 / z_l
    E_l = 1 on electrode l: B_l = -K E_l,           D_lm = E_l^T K E_m

In the first, D grows like 1/z while I = D U - B^T w does not; in the second it does not depend on z
at all, but is too large once 1/z is small. The one with the smaller D_ll is taken: both ends,
shunt electrodes (z -> 0) and buried ones (z -> infinity), keep all their digits.

One unknown is grounded through a conductance of the stiffness's own size. Currents that add up to
zero send none there, so potentials only shift by a constant, and A stays regular for large z.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.simulator.electrical.assembly import Assembly, Contact, sums

Array = NDArray[np.float64]
Numbers = NDArray[np.inexact]
Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class System:
    """A w = B U, I = D U - B^T w, u = w + E U.

    Attributes:
        values: of the lower triangle of A, at `Places.rows` and `columns`.
        coupling: B, (unknowns, electrodes) [S].
        admittance: D, (electrodes, electrodes) [S].
        lift: E, (unknowns, electrodes).
    """

    values: Numbers
    coupling: Numbers
    admittance: Numbers
    lift: Array

    @property
    def lifted(self) -> NDArray[np.bool_]:
        """Electrodes whose potential is lifted off, (electrodes,)."""
        return np.asarray(self.lift.any(axis=0))

    def impedance(self, T: Numbers) -> Numbers:
        """Z [ohm], zero row and column sums, from T = B^T A^-1 B.

        U = (D - T)^-1 I. Written as D^-1 + D^-1 T (D - T)^-1, a buried electrode's own share
        stands apart from the body's, which keeps its digits. Taking off the means leaves the
        currents that add up to zero.
        """
        T = 0.5 * (T + T.T)
        own = np.linalg.inv(self.admittance)
        Z = zero_sums(own) + zero_sums(own @ T @ np.linalg.inv(self.admittance - T))
        symmetric: Numbers = 0.5 * (Z + Z.T)
        return symmetric


class Places:
    """Where the system's values stand, and what of it does not depend on the scene.

    Attributes:
        rows, columns: of each value in the lower triangle of A; values of equal place add up.
    """

    def __init__(self, assembly: Assembly) -> None:
        """Find the grounded unknown and the functions that are one on electrodes."""
        self._ground = _ground(assembly)
        self.rows: Indices = np.append(assembly.rows, self._ground)
        self.columns: Indices = np.append(assembly.columns, self._ground)
        self._lift, self._liftable = _lift(assembly)
        # Entries of K that meet a lifted unknown, either way round: K E needs no others.
        count = len(assembly.rows) - assembly.contact_entries
        rows, columns = assembly.rows[:count], assembly.columns[:count]
        off = rows != columns
        entry = np.concatenate([np.arange(count), np.flatnonzero(off), [-1]])
        to = np.concatenate([rows, columns[off], [self._ground]])
        source = np.concatenate([columns, rows[off], [self._ground]])
        lifted = np.abs(self._lift).max(axis=1)
        met = np.flatnonzero(lifted[source])
        self._entry, self._to, self._source = entry[met], to[met], source[met]
        self._grounded = np.flatnonzero((rows == self._ground) & (columns == self._ground))

    def system(
        self, stiffness: Array, contact: Contact, lifted: NDArray[np.bool_] | None = None
    ) -> System:
        """The system for stiffness values and electrode terms, each electrode in its own form.

        Which electrodes have their potential lifted off is chosen here unless it is given.
        """
        ground = stiffness[self._grounded].sum()
        values = np.append(stiffness, ground)
        E = self._lift
        KE = np.stack(
            [
                sums(self._to, values[self._entry] * E[self._source, electrode], len(E))
                for electrode in range(E.shape[1])
            ],
            axis=1,
        )
        energy = E.T @ KE
        if lifted is None:
            lifted = self._liftable & (np.diag(energy) < np.abs(contact.admittance))
        admittance = np.where(np.outer(lifted, lifted), energy, 0.0) + np.diag(
            np.where(lifted, 0.0, contact.admittance)
        )
        return System(
            values=np.concatenate([stiffness, contact.values, [ground]]),
            coupling=np.where(lifted, -KE, contact.coupling),
            admittance=admittance,
            lift=np.where(lifted, E, 0.0),
        )


def zero_sums(Z: Numbers) -> Numbers:
    """Z less the means of its rows and columns."""
    Z = Z - Z.mean(axis=0)
    centred: Numbers = Z - Z.mean(axis=1)[:, None]
    return centred


def _ground(assembly: Assembly) -> int:
    """The unknown that is grounded: where electrode 0 touches most."""
    own = np.flatnonzero(assembly.facet_electrode == 0)
    loads = np.einsum("fiq,fq->fi", assembly.facet_shape[own], assembly.facet_weights[own])
    # A function that a constant potential has no share of would ground nothing.
    constant = assembly.space.element.indicator(-np.inf, np.inf)[: loads.shape[1]]
    loads = np.where(constant != 0.0, loads, -np.inf)
    piece, function = np.unravel_index(loads.argmax(), loads.shape)
    return int(assembly.facet_numbers[own][piece, function])


def _lift(assembly: Assembly) -> tuple[Array, NDArray[np.bool_]]:
    """E (unknowns, electrodes), and the electrodes whose column is one on them, zero on others."""
    E = np.zeros((assembly.unknowns, assembly.electrodes))
    outer = assembly.facet_numbers.shape[1]
    touching = np.abs(assembly.facet_shape).max(axis=2) > 1e-12
    heights = assembly.contacts.corners[..., 2]
    for electrode in range(assembly.electrodes):
        own = np.flatnonzero(assembly.facet_electrode == electrode)
        one = assembly.space.element.indicator(heights[own].min(), heights[own].max())[:outer]
        piece, function = np.nonzero(touching[own] & (one != 0.0))
        E[assembly.facet_numbers[own[piece], function], electrode] = one[function]
    on = np.einsum("fiq,fie->fqe", assembly.facet_shape, E[assembly.facet_numbers])
    wanted = np.eye(assembly.electrodes)[assembly.facet_electrode][:, None]
    wrong = np.abs(on - wanted).max(axis=(0, 1))
    return E, wrong < 1e-9
