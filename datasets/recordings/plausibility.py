"""Plausibility of a recording's lengths and forces, by which other units are noticed."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from eitskin.bounds import LONGEST
from eitskin.errors import ConfigurationError, DataError
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface

LARGEST_FORCE: Final = 500.0  # N on a skin; more is most likely grams
_MARGIN: Final = 0.01  # of the sensor's size, by which positions may err at the rim
_SCATTERED, _LEAST_SPAN = 10, 200  # so many positions spread over this fraction of the sensor
_UNIT: Final = "--length-unit mm, cm or um where they are in another unit"


def origin_on(design: SensorDesign | None, origin: str) -> tuple[float, float]:
    """Position of the recording's origin on the design [m].

    Args:
        design: of the sensor; None where unknown.
        origin: "corner" of the bounding box, its "centre", or "X,Y" [m].

    Raises:
        ConfigurationError: for another text, and a centre without a design.
    """
    if origin == "corner":
        return 0.0, 0.0
    if origin == "centre":
        if design is None:
            raise ConfigurationError(
                "an origin at the centre needs the sensor's design; add --sensor DESIGN.toml"
            )
        return design.centre[:2]
    try:
        x, y = (float(cell) for cell in origin.split(","))
    except ValueError:
        raise ConfigurationError(
            f"expected an origin as corner, centre or X,Y in metres, got '{origin}'"
        ) from None
    return x, y


def require_plausible(
    known: Mapping[str, NDArray[Any]], design: SensorDesign | None, origin: tuple[float, float]
) -> None:
    """Raise DataError for positions beside the sensor, and sizes and forces of other units.

    Args:
        known: labels of frames under the names of `Dataset`'s attributes, positions as they are on
            the design.
        design: of the sensor; None where unknown.
        origin: of the recording's positions on the design [m], for the message.
    """
    extent = LONGEST
    if design is not None and not isinstance(design.outline, Surface):
        extent = max(design.outline.length, design.outline.width)
    for name, meaning in (("touch_depth", "depths"), ("touch_radius", "radii of indenters")):
        sizes = _finite(known, name)
        if sizes.size and (sizes.min() < 0 or sizes.max() > extent):
            raise DataError(
                f"{meaning} must be in metres, from 0 to {extent:g} m, got {sizes.min():g} to "
                f"{sizes.max():g}; import with {_UNIT}"
            )
    force = _finite(known, "touch_force")
    if force.size and np.abs(force).max() > LARGEST_FORCE:
        raise DataError(
            f"forces must be in newtons, up to {LARGEST_FORCE:g} N, got {force.max():g}; import "
            "with --column force=NAME*0.00981 where they are in grams"
        )
    _require_positions(known, design, extent, origin)
    known_places = [np.isfinite(known[name]) for name in ("touch_x", "touch_y") if name in known]
    if known_places and (wrong := int((known_places[0] != known_places[1]).any(axis=1).sum())):
        raise DataError(
            f"a touch needs both touch_x and touch_y, but {wrong} frames have one of x and y only; "
            "fill both, or neither"
        )


def _require_positions(
    known: Mapping[str, NDArray[Any]],
    design: SensorDesign | None,
    extent: float,
    origin: tuple[float, float],
) -> None:
    names = ("touch_x", "touch_y")
    given = np.concatenate([_finite(known, n) - o for n, o in zip(names, origin, strict=True)])
    if not given.size:
        return
    least, most = given.min(), given.max()
    if np.abs(given).max() > min(LONGEST, 3 * extent):
        limit = f"up to {LONGEST:g} m" if design is None else f"on a sensor of {extent:g} m"
        raise DataError(
            f"positions must be in metres, {limit}, got {least:g} to {most:g}; import with {_UNIT}"
        )
    if design is None or isinstance(design.outline, Surface):
        return
    points = np.stack([np.ravel(known[name]) for name in names], axis=-1)
    points = points[np.isfinite(points).all(axis=1)]
    span = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    if len(np.unique(points, axis=0)) >= _SCATTERED and span < extent / _LEAST_SPAN:
        raise DataError(
            f"{len(points)} positions on a sensor of {extent:g} m lie within {span:g} m; expected "
            "metres: import with the --length-unit that the file has"
        )
    outside = ~design.outline.contains(points, -_MARGIN * extent)
    if outside.any():
        first = points[int(np.flatnonzero(outside)[0])]
        centred = "; import with --origin centre where they count from the sensor's middle"
        raise DataError(
            f"positions must lie on the sensor, x from 0 to {design.outline.length:g} m and y from "
            f"0 to {design.outline.width:g} m, but {int(outside.sum())} of {len(points)} are "
            f"beside it, the first at ({first[0]:g}, {first[1]:g}) m"
            f"{centred if least < 0 and origin == (0.0, 0.0) else ''}"
        )


def _finite(known: Mapping[str, NDArray[Any]], name: str) -> NDArray[np.float64]:
    """Finite values of a label, or none."""
    values = np.asarray(known.get(name, ()), dtype=np.float64)
    return values[np.isfinite(values)]
