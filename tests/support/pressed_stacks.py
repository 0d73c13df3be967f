"""Designs and fields that the tests of pressed stacks share."""

import numpy as np

from eitskin.geometry import Polygon, SensorDesign
from eitskin.geometry.design.regular_layouts import uniform

THICKNESS = 0.005  # of the gel [m]
L_SHAPE = Polygon(((0, 0), (0.1, 0), (0.1, 0.05), (0.05, 0.05), (0.05, 0.1), (0, 0.1)))


def design_on(outline, count=8) -> SensorDesign:
    """The reference layer on another outline."""
    return SensorDesign(outline, THICKNESS, uniform(outline, count))


def total(found, points) -> np.ndarray:
    """Displacement and mean stress of all fields of a correction at points (n, 3), (n, 4)."""
    fields, _ = found
    return sum(field.values(points[:, None])[:, 0].T for field in fields)


def places_in(outline, count=60, seed=1) -> np.ndarray:
    """Random points of the gel (count, 3) [m]."""
    box = (outline.length, outline.width, THICKNESS)
    points = np.random.default_rng(seed).uniform((0, 0, 0), box, (8 * count, 3))
    return points[outline.contains(points[:, :2], 1e-3)][:count]
