"""Ridge regression of states, angle and touches."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from eitskin.training.baselines.table import Array, TableMethod
from eitskin.training.method.settings import Progress

PARAMETERS = np.logspace(-6, 3, 37)  # tried, relative to the number of frames


@dataclass(frozen=True, slots=True)
class RidgeOptions:
    """Options of ridge regression.

    Attributes:
        squares: whether the squares of the features are features, too.
    """

    squares: bool = True


class RidgeMethod(TableMethod):
    """Ridge regression; generalised cross-validation chooses the parameter of each table.

    w = (X^T X + lambda I)^-1 X^T y, with the lambda of the least
    |y - X w|^2 / (m - trace X (X^T X + lambda I)^-1 X^T)^2 (Golub, Heath and Wahba 1979).
    """

    KIND: ClassVar[str] = "ridge"
    OPTIONS: ClassVar[type[Any]] = RidgeOptions
    __slots__ = ()

    @classmethod
    def learn(
        cls,
        features: Array,
        truth: Array,
        options: RidgeOptions,
        seed: int,  # noqa: ARG003  nothing is random
        progress: Progress,  # noqa: ARG003  done at once
    ) -> dict[str, Array]:
        table = with_squares(features) if options.squares else features
        middle = table.mean(axis=0)
        U, s, Vt = np.linalg.svd(table - middle, full_matrices=False)
        projected, rest = U.T @ truth, np.sum(truth**2)
        errors, m = [], len(table)
        for parameter in m * PARAMETERS:
            kept = s**2 / (s**2 + parameter)
            misfit = rest - np.sum((1.0 - (1.0 - kept[:, None]) ** 2) * projected**2)
            errors.append(misfit / (m - kept.sum()) ** 2)
        chosen = m * PARAMETERS[int(np.argmin(errors))]
        weights: Array = Vt.T @ ((s / (s**2 + chosen))[:, None] * projected)
        return {"weights": weights, "middle": middle}

    @staticmethod
    def apply(arrays: Mapping[str, NDArray[Any]], features: Array) -> Array:
        weights, middle = arrays["weights"], arrays["middle"]
        table = with_squares(features) if len(weights) > features.shape[1] else features
        values: Array = (table - middle) @ weights
        return values


def with_squares(features: Array) -> Array:
    """Features (n, F) and their squares, (n, 2 F)."""
    return np.hstack([features, features**2])
