"""Compiled loops of the batched solver, with element matrices in single precision.

Plain twins in double: `cem_system.ElementProducts`, `assembly.Assembly.condense_into` and
`batch.project_galerkin`.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.compiled import kernel

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Numbers = NDArray[np.int32]
Integer = Any  # an int


@kernel("void(f8[:,::1], i4[:,::1], f8[::1], i8, f4[:,:,::1])")
def gather(vectors: Array, numbers: Numbers, one: Array, first: Integer, found: Single) -> None:
    """Coefficients of vectors (n, k) in each element, less those of its constant.

    Args:
        vectors: (unknowns, k).
        numbers: numbers of the unknowns of each element, (elements, m).
        one: coefficients of the constant function one, (m,).
        first: function whose coefficient is the constant that is subtracted.
        found: output, (elements, m, k).
    """
    columns = vectors.shape[1]
    constant = np.empty(columns)
    for e in range(len(numbers)):
        constant[:] = vectors[numbers[e, first]]
        for i in range(numbers.shape[1]):
            row, share = vectors[numbers[e, i]], one[i]
            for k in range(columns):
                found[e, i, k] = row[k] - share * constant[k]


@kernel("void(f4[:,:,::1], i4[:,::1], f8[::1], i8, f8[:,::1])")
def scatter(parts: Single, numbers: Numbers, one: Array, first: Integer, found: Array) -> None:
    """Add parts (elements, m, k) to `found` (unknowns, k), those of a constant adding to zero.

    Other arguments as of `gather`.
    """
    columns = found.shape[1]
    total = np.empty(columns)
    for e in range(len(numbers)):
        total[:] = 0.0
        for i in range(numbers.shape[1]):
            row, share = found[numbers[e, i]], one[i]
            for k in range(columns):
                value = np.float64(parts[e, i, k])
                row[k] += value
                total[k] += share * value
        row = found[numbers[e, first]]
        for k in range(columns):
            row[k] -= total[k]


@kernel("void(f8[:,:,::1], i4[:,::1], f8[:,::1], f8[:,::1])")
def add_products(matrices: Array, numbers: Numbers, vectors: Array, total: Array) -> None:
    """Add matrices (elements, m, m) times vectors (unknowns, k) to `total` (unknowns, k).

    Unknowns of each element are in `numbers` (elements, m).
    """
    for e in range(len(numbers)):
        for i in range(numbers.shape[1]):
            row = total[numbers[e, i]]
            for j in range(numbers.shape[1]):
                entry, other = matrices[e, i, j], vectors[numbers[e, j]]
                for k in range(len(row)):
                    row[k] += entry * other[k]


@kernel("void(f4[:,::1], f4[:,:,::1])")
def eliminate(entries: Single, found: Single) -> None:
    """Inner functions of element matrices: the product found^T found is what condensation takes.

    Args:
        entries: lower triangle of the outer functions, rows of the inner ones by the outer ones,
            and rows of the inner ones, (elements, entries).
        found: output, L^-1 times the rows by the outer functions, for the Cholesky factor L of
            the inner ones, (elements, inner, outer).
    """
    inner, outer = found.shape[1:]
    pairs = outer * (outer + 1) // 2
    within = pairs + inner * outer
    lower = np.empty((inner, inner), np.float32)
    for e in range(len(entries)):
        row, solved = entries[e], found[e]
        for a in range(inner):
            for b in range(a + 1):
                s = row[within + a * inner + b]
                for c in range(b):
                    s -= lower[a, c] * lower[b, c]
                lower[a, b] = math.sqrt(s) if a == b else s / lower[b, b]
            target = solved[a]
            target[:] = row[pairs + a * outer : pairs + (a + 1) * outer]
            for c in range(a):
                share, other = lower[a, c], solved[c]
                for i in range(outer):
                    target[i] -= share * other[i]
            share = np.float32(1.0) / lower[a, a]
            for i in range(outer):
                target[i] *= share


@kernel("void(f4[:,::1], f4[:,:,::1])")
def subtract_triangles(entries: Single, found: Single) -> None:
    """Set symmetric `found` (elements, m, m) to the triangles in `entries` less what it holds."""
    for e in range(len(entries)):
        row, whole, start = entries[e], found[e], 0
        for i in range(found.shape[1]):
            for j in range(i + 1):
                value = row[start + j] - whole[i, j]
                whole[i, j] = value
                whole[j, i] = value
            start += i + 1


@kernel("void(f8[:,::1], f8, f8[:,::1], f8[::1])")
def factor(gram: Array, dependent: float, lower: Array, scale: Array) -> None:
    """Cholesky factor of a Gram matrix (s, s) that leaves linearly dependent vectors out.

    Args:
        gram: gram of the vectors.
        dependent: energy of a vector beyond those before it, over its own, that counts as none.
        lower: zeros; set to the factor for vectors of unit energy, with its diagonal inverted, zero
            for a vector left out.
        scale: output, the inverse square root of each vector's energy, (s,).
    """
    for i in range(len(gram)):
        scale[i] = 1.0 / math.sqrt(gram[i, i]) if gram[i, i] > 0.0 else 0.0
        for j in range(i + 1):
            s = gram[i, j] * scale[i] * scale[j]
            for c in range(j):
                s -= lower[i, c] * lower[j, c]
            if j < i:
                lower[i, j] = s * lower[j, j]
            elif s > dependent:
                lower[i, i] = 1.0 / math.sqrt(s)


@kernel("void(f8[:,::1], f8[:,::1], f8, f8[:,::1], f8[:,::1])")
def project(gram: Array, loads: Array, dependent: float, found: Array, product: Array) -> None:
    """Galerkin solution.

    Args:
        gram: gram of the vectors, (s, s).
        loads: loads of the vectors, (s, k).
        dependent: limit of energy as in `factor`.
        found: output, the coefficients of the vectors, (s, k).
        product: output, loads^T found, (k, k).
    """
    size, columns = loads.shape
    lower, scale = np.zeros((size, size)), np.empty(size)
    factor(gram, dependent, lower, scale)
    product[:] = 0.0
    for k in range(columns):
        for i in range(size):
            s = loads[i, k] * scale[i]
            for c in range(i):
                s -= lower[i, c] * found[c, k]
            found[i, k] = s * lower[i, i]
        for m in range(k + 1):
            for i in range(size):
                product[k, m] += found[i, k] * found[i, m]
            product[m, k] = product[k, m]
    for k in range(columns):
        for i in range(size - 1, -1, -1):
            s = found[i, k]
            for c in range(i + 1, size):
                s -= lower[c, i] * found[c, k]
            found[i, k] = s * lower[i, i]
    for i in range(size):
        found[i] *= scale[i]
