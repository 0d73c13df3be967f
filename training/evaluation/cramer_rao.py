"""Cramer-Rao bound on the errors of touches and bend angle estimated from one frame.

The measurements are the logarithms of a frame's resistances over those of a reference, as in the
pipelines, so that noise is relative, and white. With derivatives G by the parameters, divided by
the standard deviation of each measurement, the covariance of every unbiased estimate is at least
(G G^T)^-1, the inverse of the Fisher information (Rao 1945, Cramer 1946).
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ellipe

from eitskin.geometry import Bend, ConfigurationError
from eitskin.simulator import Instrument, Scene, Simulator

Array = NDArray[np.float64]

PLACE_STEP = 1e-3
"""Step of the finite differences in x and y of a touch [m]."""
FORCE_STEP = 0.02
"""Step of a force, relative to the force."""
_ANGLE_STEP = 0.5  # deg
_SINGULAR = 1e-12  # least eigenvalue of a Fisher information scaled to a unit diagonal
# Difference stencils of second order: offsets in steps, and weights of the derivative.
_STENCILS = (
    ((-1.0, 1.0), (-0.5, 0.5)),
    ((0.0, 1.0, 2.0), (-1.5, 2.0, -0.5)),
    ((0.0, -1.0, -2.0), (1.5, -2.0, 0.5)),
)


@dataclass(frozen=True, slots=True, eq=False)
class SceneBound:
    """Least standard errors of unbiased estimates from one frame of a scene with k touches.

    Attributes:
        place: sqrt(var x + var y) of the position of each touch (k,) [m].
        distance: mean distance between true and estimated position of each touch (k,) [m], as
            localisation errors are reported; smaller than `place`.
        force: standard error of the force of each touch (k,) [N].
        angle_deg: standard error of the bend angle [deg]; 0 for a known angle.
    """

    place: Array
    distance: Array
    force: Array
    angle_deg: float


@dataclass(frozen=True, slots=True, eq=False)
class SceneDerivatives:
    """Derivatives of the m measured resistances of a scene with k touches by its parameters.

    Attributes:
        resistance: real parts of the measurements (m,) [ohm].
        by_touch: derivatives of log resistance by x [1/m], y [1/m] and force [1/N], (k, 3, m).
        by_angle: the same by the bend angle (m,) [1/deg].
    """

    resistance: Array
    by_touch: Array
    by_angle: Array

    def noise(self, instrument: Instrument, full_scale: float) -> Array:
        """Standard deviation of an instrument's white noise, relative to each resistance (m,).

        Noise in quadrature changes the phase and, to first order, not the magnitude.
        """
        return instrument.deviation(full_scale) / np.abs(self.resistance)

    def bound(
        self,
        deviation: ArrayLike,
        reference_frames: float = 1.0,
        *,
        angle_known: bool = False,
    ) -> SceneBound:
        """Cramer-Rao bound for one frame against a reference.

        Args:
            deviation: standard deviation of the noise of one frame, relative to each resistance,
                (m,) or one number.
            reference_frames: number of frames whose mean the reference is; math.inf for a
                reference without noise.
            angle_known: whether the bend angle is known.

        Raises ConfigurationError for parameters that the measurements do not determine.
        """
        noise = np.broadcast_to(np.asarray(deviation, dtype=float), self.by_angle.shape)
        touches = len(self.by_touch)
        rows = [
            *(row for touch in self.by_touch for row in touch),
            *([] if angle_known else [self.by_angle]),
        ]
        least = cramer_rao_bound(rows, noise * math.sqrt(1.0 + 1.0 / reference_frames))
        parts = [slice(start, start + 3) for start in range(0, 3 * touches, 3)]
        blocks = np.array([least[part, part] for part in parts]).reshape(-1, 3, 3)
        positions = blocks[:, :2, :2]
        return SceneBound(
            place=np.sqrt(np.trace(positions, axis1=1, axis2=2)),
            distance=mean_distance(positions),
            force=np.sqrt(blocks[:, 2, 2]),
            angle_deg=0.0 if angle_known else float(np.sqrt(least[3 * touches, 3 * touches])),
        )


def cramer_rao_bound(derivatives: ArrayLike, deviation: ArrayLike) -> Array:
    """Least covariance of unbiased estimates of all parameters, (parameters, parameters).

    The inverse of the Fisher information, which is first scaled to a unit diagonal: parameters in
    metres next to parameters in newtons would cost digits.

    Args:
        derivatives: derivatives of the measurements' means by the parameters, (parameters,
            measurements).
        deviation: standard deviation of the noise of each measurement, (measurements,) or one.

    Raises:
        ConfigurationError: for parameters that the measurements do not determine.
    """
    white = np.asarray(derivatives, dtype=float) / np.asarray(deviation, dtype=float)
    sizes = np.linalg.norm(white, axis=1)
    if not np.all(sizes > 0.0):
        nothing = np.flatnonzero(~(sizes > 0.0)).tolist()
        raise ConfigurationError(
            f"the measurements do not depend on parameters {nothing}; leave these out"
        )
    scaled = white / sizes[:, None]
    values, vectors = np.linalg.eigh(scaled @ scaled.T)
    if values[0] < _SINGULAR:
        mixed = np.flatnonzero(np.abs(vectors[:, 0]) > 0.1).tolist()
        raise ConfigurationError(
            f"the measurements do not determine parameters {mixed} separately; fix one"
        )
    root = vectors / (sizes[:, None] * np.sqrt(values))
    least: Array = root @ root.T
    return least


def mean_distance(covariance: Array) -> Array:
    """Mean distance (...) from its mean of a normal position with covariance (..., 2, 2).

    With variances a >= b along the principal axes it is sqrt(2 a / pi) E(1 - b / a), E the complete
    elliptic integral of the second kind of the parameter m = k^2: the mean over directions of
    sqrt(a cos^2 + b sin^2), times the mean sqrt(pi / 2) of a Rayleigh distribution.
    """
    values = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
    small, large = values[..., 0], values[..., 1]
    ratio = np.divide(small, large, out=np.ones_like(large), where=large > 0.0)
    distance: Array = np.sqrt(2.0 * large / math.pi) * ellipe(1.0 - ratio)
    return distance


def scene_derivatives(
    simulator: Simulator,
    scene: Scene,
    instrument: Instrument | None = None,
) -> SceneDerivatives:
    """Derivatives of a scene's measurements by central differences, one-sided next to a limit.

    Args:
        simulator: simulator of the sensor.
        scene: bend and touches, each with a force.
        instrument: whose circuit the sensor is part of; an ideal meter when omitted.

    Raises:
        ConfigurationError: for a touch that is given by its depth, or a parameter that cannot
            change to either side.
    """
    if any(touch.depth is not None for touch in scene.touches):
        raise ConfigurationError(
            "expected touches with forces, got a touch with a depth; give a force instead"
        )
    parameters: list[tuple[int | None, str, float]] = [
        (number, name, step)
        for number, touch in enumerate(scene.touches)
        for name, step in (
            ("x", PLACE_STEP),
            ("y", PLACE_STEP),
            ("force", FORCE_STEP * touch.force),
        )
    ]
    scenes, weights = [scene], []
    for number, name, step in (*parameters, (None, "angle_deg", _ANGLE_STEP)):
        changed, factors = _stencil(simulator, scene, number, name, step)
        weights.append((slice(len(scenes), len(scenes) + len(changed)), np.array(factors) / step))
        scenes += changed
    measured = simulator.measure_all(scenes, tolerance=0.0, instrument=instrument).real
    if instrument is not None:
        measured = measured[:, 0]
    logarithms = np.log(np.abs(measured))
    rows = np.array([weight @ logarithms[part] for part, weight in weights])
    return SceneDerivatives(
        resistance=measured[0],
        by_touch=rows[:-1].reshape(len(scene.touches), 3, measured.shape[1]),
        by_angle=rows[-1],
    )


def _stencil(
    simulator: Simulator, scene: Scene, number: int | None, name: str, step: float
) -> tuple[list[Scene], tuple[float, ...]]:
    """Scenes and weights of the first stencil whose scenes are all possible."""
    for multiples, weights in _STENCILS:
        try:
            scenes = [
                _perturb_scene(scene, number, name, multiple * step) for multiple in multiples
            ]
            for each in scenes:
                simulator.deformation(each)
        except ConfigurationError:
            continue
        return scenes, weights
    whose = "the bend" if number is None else f"touch {number}"
    raise ConfigurationError(
        f"no room to change {name} of {whose} by {step:g} either way; the bound needs a scene that "
        "is possible a little to one side of every parameter"
    )


def _perturb_scene(scene: Scene, number: int | None, name: str, step: float) -> Scene:
    if number is None:
        return replace(scene, bend=Bend(scene.bend.angle_deg + step))
    touches = list(scene.touches)
    touches[number] = replace(touches[number], **{name: getattr(touches[number], name) + step})
    return replace(scene, touches=tuple(touches))
