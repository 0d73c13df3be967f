"""Estimated memory of a forward model, refused beyond a bound before the matrices are made."""

import math

from eitskin.errors import ConfigurationError
from eitskin.simulator.electrical.elements import ExtrudedElement
from eitskin.simulator.electrical.function_space import FunctionSpace

MOST_MEMORY = 8e9  # [byte]

# Bytes per number of each part, fitted to peaks of six models of 4,000 to 54,000 unknowns, of all
# three kinds of cells. Misfits are up to 1.5; the one of tetrahedra is 2.2 too low, which has the
# mesher's own memory in its peak.
_PER_ENTRY = 150.0  # of the element matrices: values, rows, columns, and copies to sort
_PER_PRODUCT = 200.0  # of the reference matrix, at each quadrature point of an element
_PER_POINT = 300.0  # deformation gradients and tensors
_PER_FACTOR = 24.0  # numbers of both factors, and their rows


def estimated_memory(space: FunctionSpace) -> float:
    """Peak memory of one frame [byte], from the numbers of unknowns, entries and points.

    The factors of n unknowns with b unknowns in each column of cells have about
    1.25 n b log2(n / b) entries, as those of a plane mesh (nested dissection, George 1973), and
    2.7 n^(4/3) entries for tetrahedra, as those of a body.
    """
    elements, outer = space.numbers.shape
    functions, n = outer + space.element.inner, float(space.unknowns)
    in_element = len(space.rule.weights)
    if isinstance(space.element, ExtrudedElement):
        across = n / elements
        factors = 1.25 * n * across * max(1.0, math.log2(n / across))
    else:
        factors = 2.7 * n ** (4.0 / 3.0)
    needed: float = (
        _PER_ENTRY * elements * _pairs(outer)
        + _PER_PRODUCT * _pairs(functions) * in_element
        + _PER_POINT * elements * in_element
        + _PER_FACTOR * factors
    )
    return needed


def require_memory(space: FunctionSpace) -> None:
    """Raise ConfigurationError for functions whose matrices need more than `MOST_MEMORY`."""
    needed = estimated_memory(space)
    if needed > MOST_MEMORY:
        raise ConfigurationError(
            f"a forward model of {space.unknowns} unknowns needs about {needed / 1e9:.3g} GB of "
            f"memory, more than the {MOST_MEMORY / 1e9:g} GB that are allowed; choose a faster "
            "resolution or larger cells; presses by small indenters need small cells"
        )


def _pairs(functions: int) -> float:
    return 0.5 * functions * (functions + 1)
