"""Upper side of a body: heights over places, and the check of touches."""

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.surface import Surface
from eitskin.simulator.scene.scene import Touch

Array = NDArray[np.float64]


def require_above(surface: Surface, touch: Touch) -> None:
    """Raise ConfigurationError for a touch beside the body."""
    points, faces = surface.triangles()
    if np.isnan(heights(points[faces], np.array([[touch.x, touch.y]]))).any():
        (x, y, _), (end, far, _) = surface.bounds.tolist()
        raise ConfigurationError(
            f"a touch must lie above the body, which reaches from x = {x:g} to {end:g} m and from "
            f"y = {y:g} to {far:g} m, got ({touch.x:g}, {touch.y:g}) m; positions are those of the "
            "surface's file times its scale"
        )


def heights(triangles: Array, places: Array) -> Array:
    """Greatest height of triangles (n, 3, 3) above places (k, 2) [m], (k,); NaN beside them."""
    found = np.full(len(places), np.nan)
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    doubled = _cross(b - a, c - a)
    low, high = triangles[..., :2].min(axis=1), triangles[..., :2].max(axis=1)
    slack = 1e-9 * float(np.ptp(triangles[..., :2]))
    for k, place in enumerate(places):
        near = np.all((low <= place + slack) & (high >= place - slack), axis=1) & (doubled != 0.0)
        one = _cross(place - a[near, :2], c[near] - a[near]) / doubled[near]
        other = _cross(b[near] - a[near], place - a[near, :2]) / doubled[near]
        inside = (one >= -1e-9) & (other >= -1e-9) & (one + other <= 1.0 + 1e-9)
        if inside.any():
            first = a[near, 2][inside]
            z = first + one[inside] * (b[near, 2][inside] - first)
            z += other[inside] * (c[near, 2][inside] - first)
            found[k] = z.max()
    return found


def _cross(a: Array, b: Array) -> Array:
    product: Array = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return product
