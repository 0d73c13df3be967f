"""Designs and fields that the tests of pressed stacks share."""

import numpy as np

from eitskin.geometry import Polygon, SensorDesign
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.simulator.deformation.tabled_corrections import rectangle_sums

THICKNESS = 0.005  # of the gel [m]
L_SHAPE = Polygon(((0, 0), (0.1, 0), (0.1, 0.05), (0.05, 0.05), (0.05, 0.1), (0, 0.1)))


def design_on(outline, count=8) -> SensorDesign:
    """The reference layer on another outline."""
    return SensorDesign(outline, THICKNESS, uniform(outline, count))


def corrected(table, *presses) -> tuple:
    """Fields of a press (x, y, depth), or of what two change of each other, and its sinking."""
    sums = rectangle_sums(table.design, 1, 4) if getattr(table, "strip", None) else None
    if getattr(table, "sides", None):
        sums = rectangle_sums(table.design, 1, 4)
    places = (np.array([press]) for press in presses)
    (fields,), (extra,) = table.evaluate(*places, np.zeros(1, int), sums)
    own = fields if isinstance(fields, list) else [] if fields is None else [fields]
    scales = np.array([1.0, 1.0, table.design.thickness, table.modulus or 1.0])
    scales = getattr(table, "scales", scales)
    return [*own, *(sums.fields(table.design.thickness, scales) if sums else [])], float(extra)


def total(found, points) -> np.ndarray:
    """Displacement and mean stress of all fields of a correction at points (n, 3), (n, 4)."""
    fields, _ = found
    return sum(field.values(points[:, None])[:, 0].T for field in fields)


def places_in(outline, count=60, seed=1) -> np.ndarray:
    """Random points of the gel (count, 3) [m]."""
    box = (outline.length, outline.width, THICKNESS)
    points = np.random.default_rng(seed).uniform((0, 0, 0), box, (8 * count, 3))
    return points[outline.contains(points[:, :2], 1e-3)][:count]
