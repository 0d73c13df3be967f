"""Equilibrium under loads: Newton's method with line search, and load stepping."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from eitskin.errors import ConfigurationError
from eitskin.simulator.linalg.multifrontal import Factors
from eitskin.threads import one_thread

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_ITERATIONS = 20
_FULL_STEPS = 6
_TOLERANCE = 1e-7  # last correction over the largest unknown; the error is its square
_CHORDS = 4  # most corrections by the factors of an earlier iterate
_CONTRACTION = 0.1  # largest ratio of such a correction to the one before
_HALVINGS = 6  # of a correction that would turn a cell inside out
MIN_STEP = 1.0 / 200.0


class SolidError(ConfigurationError):
    """No stable equilibrium was found under a load.

    Attributes:
        reached: fraction of the load that was carried.
    """

    def __init__(self, message: str, reached: float = 0.0) -> None:
        """Store the message (load asked for, load carried, remedy) and the fraction reached."""
        super().__init__(message)
        self.reached = reached


class SparseLU:
    """Symmetric matrix (n, n) factorised by SuperLU."""

    def __init__(self, matrix: csc_array) -> None:
        """Factorise with diagonal pivots, whose signs give the inertia.

        The next Newton iteration, which starts from the true forces, corrects the loss of accuracy.
        """
        self._lu = splu(
            matrix,
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )

    @property
    def negative(self) -> int:
        """Number of negative eigenvalues of the matrix."""
        return int(np.count_nonzero(self._lu.U.diagonal() < 0.0))

    def solve(self, right: Array) -> Array:
        """Solution (n,) for a right-hand side (n,)."""
        return np.asarray(self._lu.solve(right))


Factorisation: TypeAlias = SparseLU | Factors
Factorise = Callable[[csc_array], Factorisation]


class ForceTerm(ABC):
    """Term of the equilibrium that exerts forces on the unknowns: a solid, a contact, springs."""

    __slots__ = ()

    @property
    def multipliers(self) -> int:
        """Number of unknowns that are Lagrange multipliers, such as pressures."""
        return 0

    def elimination(self, fixed: Indices, size: int) -> Factorise:  # noqa: ARG002
        """Way to factorise stiffnesses of all but the fixed ones of `size` unknowns.

        The first term of an equilibrium is asked, which is the solid.
        """
        return SparseLU

    @abstractmethod
    def forces(self, x: Array) -> Array:
        """Forces (n,) at the unknowns x (n,)."""

    @abstractmethod
    def linearise(self, x: Array) -> tuple[Array, csc_array]:
        """Forces (n,) and symmetric stiffness (n, n) at the unknowns x (n,)."""

    def admissible(self, x: Array) -> bool:  # noqa: ARG002
        """Whether the unknowns x are possible, without inverted cells."""
        return True

    def advance(self, x: Array) -> Self:  # noqa: ARG002
        """The term after x has been reached, where its forces depend on the history."""
        return self


@dataclass(frozen=True, slots=True, eq=False)
class LinearSprings(ForceTerm):
    """Term of springs.

    Attributes:
        stiffness: symmetric, (n, n) [N/m].
        at_rest: forces where all unknowns are zero, (n,) [N].
    """

    stiffness: csc_array
    at_rest: Array | float = 0.0

    def energy(self, gap: Array) -> float:
        """Energy of the springs at elongations (n,) [J]."""
        return 0.5 * float(gap @ (self.stiffness @ gap))

    def forces(self, x: Array) -> Array:
        """Forces (n,) at the unknowns x (n,)."""
        return np.asarray(self.stiffness @ x + self.at_rest)

    def linearise(self, x: Array) -> tuple[Array, csc_array]:
        """Forces (n,) and their constant stiffness (n, n)."""
        return self.forces(x), self.stiffness


@dataclass(frozen=True, slots=True, eq=False)
class Load:
    """Prescribed unknowns and dead forces.

    Attributes:
        fixed: numbers of the prescribed unknowns.
        values: values of the prescribed unknowns, (len(fixed),).
        forces: dead forces on all unknowns, (n,).
    """

    fixed: Indices
    values: Array
    forces: Array


@one_thread()
def newton(
    terms: Sequence[ForceTerm],
    x: Array,
    load: Load,
    tolerance: float = _TOLERANCE,
    scale: float = 0.0,
    chords: bool = False,
    contraction: float = np.inf,
) -> Array:
    """Stable equilibrium near x (n,) under a load, by Newton's method.

    Corrections that would invert a cell, or increase the residual, are halved. The iteration ends
    with a correction below `tolerance` relative to the largest unknown, or to `scale` where all
    unknowns are smaller; the error is of the order of its square.

    With `chords`, corrections by the factors of the iterate before follow each iteration, where
    they contract tenfold: they take the place of the last factorisation. A
    stiffness whose factors contract has their inertia.

    Raises SolidError where no stable equilibrium is found, or a correction is `contraction` times
    the one before or more; `follow` then takes smaller steps.
    """
    free = np.setdiff1d(np.arange(len(x)), load.fixed)
    start = max(np.abs(x).max(), scale)  # where all loads are removed, x itself goes to zero
    factorise = terms[0].elimination(load.fixed, len(x))
    constraints = sum(term.multipliers for term in terms)
    last = np.inf
    for iteration in range(_ITERATIONS):
        step, factorised, residual_norm = _correction(terms, x, load, free, factorise)
        size = float(np.abs(step).max())
        if not size < contraction * last:
            raise SolidError("the corrections of Newton's method do not contract")
        last = size
        # Full steps find the contact area quickly at first; later steps must not cycle.
        limit = np.inf if iteration < _FULL_STEPS else residual_norm
        x = _line_search(terms, x, step, load.forces, free, limit)
        solution = x if size <= tolerance * max(start, np.abs(x).max()) else None
        if solution is None and chords:
            least = _CONTRACTION * tolerance**2 * max(start, float(np.abs(x).max()))
            solution = _modified_newton(terms, x, load.forces, free, factorised, size, least)
        if solution is not None:
            # The potential has a minimum over displacements, given the constraints, where there
            # are as many negative pivots as multipliers (Sylvester's law of inertia).
            if factorised.negative != constraints:
                raise SolidError("the equilibrium is unstable: it would buckle or crease")
            return solution
    raise SolidError(f"Newton's method does not converge in {_ITERATIONS} iterations")


def _modified_newton(
    terms: Sequence[ForceTerm],
    x: Array,
    loads: Array,
    free: Indices,
    factors: Factorisation,
    last: float,
    least: float,
) -> Array | None:
    """Equilibrium near x with an error below `least`, by given factors; None where they are poor.

    `last` is the largest entry of the correction before.
    """
    for _ in range(_CHORDS):
        residual = sum((term.forces(x) for term in terms), start=-loads)
        step = np.zeros_like(x)
        step[free] = factors.solve(-residual[free])
        size = float(np.abs(step).max())
        contraction, last = size / last, size
        x = x + step
        # NaN fails this comparison, too.
        if not contraction <= _CONTRACTION or not all(term.admissible(x) for term in terms):
            return None
        if contraction * size <= least:
            return x
    return None


def _correction(
    terms: Sequence[ForceTerm], x: Array, load: Load, free: Indices, factorise: Factorise
) -> tuple[Array, Factorisation, float]:
    """Newton step, factorised stiffness, and norm of the residual."""
    linearised = [term.linearise(x) for term in terms]
    residual = sum((forces for forces, _ in linearised), start=-load.forces)
    K = sum((stiffness for _, stiffness in linearised[1:]), start=linearised[0][1])
    step = np.zeros_like(x)
    step[load.fixed] = load.values - x[load.fixed]
    try:
        factorised = factorise(csc_array(K[free][:, free]))
    except RuntimeError as error:
        raise SolidError("the stiffness is singular") from error
    step[free] = factorised.solve((-residual - K @ step)[free])
    if not np.all(np.isfinite(step)):
        raise SolidError("the stiffness is singular")
    return step, factorised, float(np.linalg.norm(residual[free]))


def _line_search(
    terms: Sequence[ForceTerm], x: Array, step: Array, loads: Array, free: Indices, limit: float
) -> Array:
    """Line search by halving: x of the first residual below `limit`, or of the least."""
    best, least = x, np.inf
    for halving in range(_HALVINGS + 1):
        trial = x + 0.5**halving * step
        if not all(term.admissible(trial) for term in terms):
            continue
        residual = sum((term.forces(trial) for term in terms), start=-loads)
        residual_norm = float(np.linalg.norm(residual[free]))
        if residual_norm < least:
            best, least = trial, residual_norm
        if residual_norm < limit:
            break
    if least == np.inf:
        raise SolidError("cells are turned inside out")
    return best


def follow(
    terms: Sequence[ForceTerm],
    x: Array,
    path: Callable[[float], Load],
    first_step: float = 1.0,
    solve: Callable[[Sequence[ForceTerm], Array, Load], Array] = newton,
    remedy: str = "Load it less, or refine the mesh where it is strained most",
    min_step: float = MIN_STEP,
) -> tuple[Array, tuple[ForceTerm, ...]]:
    """Load stepping: equilibrium under path(1) from x under path(0), with adaptive steps.

    Returns the unknowns (n,) and the advanced terms, solved again where these exert other forces.

    Raises SolidError, with the fraction reached and a remedy, where even small steps find no
    equilibrium; `min_step` is the smallest.
    """
    t, step, growth = 0.0, first_step, 2.0
    previous, previous_t = x, 0.0
    while t < 1.0:
        target = min(1.0, t + step)
        slope = (x - previous) / (t - previous_t) if t > previous_t else 0.0
        guess = x + (target - t) * slope
        if not all(term.admissible(guess) for term in terms):
            guess = x
        try:
            load = path(target)
            reached = solve(terms, guess, load)
            advanced = tuple(term.advance(reached) for term in terms)
            before = sum(term.forces(reached) for term in terms)
            after = sum(term.forces(reached) for term in advanced)
            if np.linalg.norm(after - before) > _TOLERANCE * np.linalg.norm(before):
                reached = solve(advanced, reached, load)
        except SolidError as error:
            step, growth = 0.5 * (target - t), 1.0
            if step < min_step:
                raise SolidError(
                    f"only {t:.1%} of the load is carried; beyond, {error}. {remedy}", reached=t
                ) from None
            continue
        previous, previous_t, x, t = x, t, reached, target
        terms = advanced
        step, growth = growth * step, 2.0
    return x, tuple(terms)
