"""Extremely randomised trees for states, angle and touches."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from eitskin.extras import require
from eitskin.training.baselines.table import Array, TableMethod
from eitskin.training.method.settings import Progress

LEAF = -1  # child of a node without any, in scikit-learn's trees


@dataclass(frozen=True, slots=True)
class TreeOptions:
    """Options of the trees.

    Attributes:
        trees: number of them.
        leaf: least number of frames in a leaf.
    """

    trees: int = 100
    leaf: int = 2


class ExtraTreesMethod(TableMethod):
    """Mean of extremely randomised trees (Geurts et al. 2006), one forest for each table.

    scikit-learn grows the trees; they are kept as arrays of their nodes and need it no longer.
    """

    KIND: ClassVar[str] = "extra-trees"
    OPTIONS: ClassVar[type[Any]] = TreeOptions
    __slots__ = ()

    @classmethod
    def learn(
        cls,
        features: Array,
        truth: Array,
        options: TreeOptions,
        seed: int,
        progress: Progress,  # noqa: ARG003  scikit-learn tells none
    ) -> dict[str, NDArray[Any]]:
        require("sklearn", "training")
        from sklearn.ensemble import ExtraTreesRegressor

        forest = ExtraTreesRegressor(
            options.trees, min_samples_leaf=options.leaf, random_state=seed
        ).fit(features, truth if truth.shape[1] > 1 else truth[:, 0])
        trees = [each.tree_ for each in forest.estimators_]
        first = np.cumsum([0, *(tree.node_count for tree in trees)])
        children = (
            [
                np.where(side == LEAF, LEAF, side + start)
                for side, start in zip((getattr(t, name) for t in trees), first[:-1], strict=True)
            ]
            for name in ("children_left", "children_right")
        )
        left, right = (np.concatenate(side).astype(np.int32) for side in children)
        return {
            "roots": first[:-1].astype(np.int32),
            "left": left,
            "right": right,
            "feature": np.concatenate([tree.feature for tree in trees]).astype(np.int32),
            "threshold": np.concatenate([tree.threshold for tree in trees]),
            "value": np.concatenate([tree.value[:, :, 0] for tree in trees]).astype(np.float32),
        }

    @staticmethod
    def apply(arrays: Mapping[str, NDArray[Any]], features: Array) -> Array:
        inputs = features.astype(np.float32)  # as scikit-learn compares them
        node = np.repeat(arrays["roots"][None], len(inputs), axis=0)
        rows = np.arange(len(inputs))[:, None]
        while (inner := arrays["left"][node] != LEAF).any():
            low = inputs[rows, arrays["feature"][node]] <= arrays["threshold"][node]
            child = np.where(low, arrays["left"][node], arrays["right"][node])
            node = np.where(inner, child, node)
        values: Array = arrays["value"][node].astype(float).mean(axis=1)
        return values
