"""Quadratic model of the misfit of one frame, and its steps within a trust region."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.training.joint.fit import lapack

Array = NDArray[np.float64]

RADIUS = 1.0  # of the trust region at first: unit steps of each unknown
POOR, GOOD = 0.25, 0.75  # share of its promise below and above which a step changes the radius
SHRINKING, GROWTH = 0.5, 2.0  # the new radius, in lengths of that step
LEAST_DAMPING, FIRST_DAMPING, MOST_DAMPING, RAISED = 1e-6, 1e-3, 1e3, 4.0
"""Damping of a step: where none is needed, the first, the last that is tried, and their ratio."""
HELD = 1e9  # addition to the Hessian that holds an unknown where it is


@dataclass(frozen=True, slots=True, eq=False)
class QuadraticModel:
    """Gauss-Newton model of the misfit in unit steps: the angle, then x, y, force of each touch.

    Attributes:
        misfit: sum of squares of the whitened residual and of the prior's terms.
        gradient: minus half the gradient of the misfit (n,).
        hessian: half the Gauss-Newton Hessian (n, n).
        residual: whitened (K,).
        jacobian: of the model, whitened (K, n).
    """

    misfit: float
    gradient: Array
    hessian: Array
    residual: Array
    jacobian: Array

    @classmethod
    def of(cls, products: Array, white: Array) -> "QuadraticModel":
        """The model whose misfit, gradient and Hessian are blocks of products (1 + n, 1 + n).

        Args:
            products: of the whitened rows with each other, and the prior.
            white: rows of a linearisation, whitened (1 + n, K).
        """
        misfit, gradient, hessian = float(products[0, 0]), products[0, 1:], products[1:, 1:]
        return cls(misfit, gradient, hessian, white[0], white[1:].T)

    def step(self, radius: float, held: NDArray[np.bool_]) -> Array:
        """Levenberg-Marquardt step (n,) to the minimum within a trust region.

        Args:
            radius: most unit steps of any unknown.
            held: unknowns that stay (n,).
        """
        step = self.damped_step(LEAST_DAMPING, held)
        damping = FIRST_DAMPING
        while np.abs(step).max() > radius and damping <= MOST_DAMPING:
            step = self.damped_step(damping, held)
            damping *= RAISED
        return step

    def damped_step(self, damping: float, held: NDArray[np.bool_]) -> Array:
        """Step (n,) with `damping` of the Hessian's diagonal."""
        damped = self.hessian.copy()
        diagonal = damped.reshape(-1)[:: len(damped) + 1]
        diagonal += damping * (1.0 + diagonal) + HELD * held
        return lapack.solve(damped, np.where(held, 0.0, self.gradient))

    def promised(self, step: Array) -> float:
        """Decrease of the misfit by a step (n,), if the model were linear."""
        return float(step @ (2.0 * self.gradient - self.hessian @ step))
