"""Choice of the forward model's solver: block or multifrontal Cholesky, or sparse LU.

A solver is made from the positions of the matrix entries. `factorise(values)` gives a
factorisation with `solve(B) = A^-1 B`; `congruence(values, B) = B^T A^-1 B`, all that impedances
need, keeps no factors and is cheaper. Matrices are real and positive definite, or complex and
symmetric with a positive definite real part, as with complex contact impedances.
"""

from typing import Literal, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.simulator.linalg.block_cholesky import BlockCholesky, level_structure
from eitskin.simulator.linalg.multifrontal_cholesky import MultifrontalCholesky
from eitskin.simulator.linalg.sparse_lu import SparseDirect

Numbers = NDArray[np.inexact]
Indices = NDArray[np.int64]
SolverName = Literal["block Cholesky", "nested dissection", "sparse LU"]


class Factorisation(Protocol):
    """A factorised symmetric matrix A."""

    def solve(self, B: Numbers) -> Numbers:
        """A^-1 B, (n, k)."""
        ...


class Solver(Protocol):
    """Solver for matrices whose lower triangle has a fixed sparsity pattern."""

    @property
    def name(self) -> str:
        """Name of the method, for people."""
        ...

    def factorise(self, values: Numbers) -> Factorisation:
        """Factorise the matrix with these values; values of equal position add up."""
        ...

    def congruence(self, values: Numbers, B: Numbers) -> Numbers:
        """B^T A^-1 B, (k, k), for the matrix A with these values."""
        ...


# Sum of the cubed block sizes per matrix entry at which blocks and fronts take equally long:
# blocks were faster below 2.2e3 and fronts above 3e3, on meshes of hexahedra, prisms and tetrahedra
# with 3,000 to 74,000 unknowns.
_BLOCK_WORK = 2.5e3


def choose_solver(
    name: SolverName | None,
    positions: tuple[Indices, Indices],
    numbers: Indices,
    middles: NDArray[np.float64],
    first: Indices,
) -> Solver:
    """The solver called `name`, or the one that suits the shape of the body.

    Long, thin bodies have small diagonal blocks: block Cholesky then beats nested dissection.
    Raises ConfigurationError for another name.

    Args:
        name: "block Cholesky", "nested dissection", "sparse LU" or None.
        positions: rows and columns of the matrix values.
        numbers: unknowns of each element, (elements, functions).
        middles: of the elements, (elements, axes) [m].
        first: elements at one end of the body, where the first strip begins.
    """
    if name is not None and name not in get_args(SolverName):
        raise ConfigurationError(
            f"solver must be one of {get_args(SolverName)} or None, got {name!r}"
        )
    if name == "sparse LU":
        return SparseDirect(*positions, int(numbers.max()) + 1)
    if name == "nested dissection":
        return MultifrontalCholesky(*positions, numbers, middles)
    level = level_structure(numbers, first)
    work = float((np.bincount(level).astype(float) ** 3).sum())
    if name is None and work > _BLOCK_WORK * len(positions[0]):
        return MultifrontalCholesky(*positions, numbers, middles)
    return BlockCholesky(*positions, level)
