"""Calibration of a trained pipeline to one sensor, from untouched frames at known angles."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.errors import ConfigurationError, DataError
from eitskin.frame import Frame
from eitskin.training.method.input_spec import InputSpec

Array = NDArray[np.float64]

FLAT_DEG = 0.05  # angle up to which a sensor counts as flat
LARGEST_RESIDUAL = 0.25  # relative to the root mean square of the known angles
LEAST_ALLOWED_DEG = 1.0  # residual that is allowed however small the angles


@dataclass(frozen=True, slots=True, eq=False)
class KnownBends:
    """Frames of one untouched sensor, flat and at known angles.

    Attributes:
        flat: mean magnitudes of the flat frames (C,) [ohm]; NaN where a measurement is bad.
        flat_frames: number of flat frames.
        angle_deg: known angles of the n bent frames (n,) [deg].
        change: of log V from the flat sensor (n, C); NaN where a measurement is bad.
        age: time since the first flat frame (n,) [s].
    """

    flat: Array
    flat_frames: int
    angle_deg: Array
    change: Array
    age: Array

    @classmethod
    def of(cls, frames: Sequence[Frame], angles_deg: ArrayLike, spec: InputSpec) -> "KnownBends":
        """Sort frames into flat and bent ones.

        Args:
            frames: untouched frames of one session.
            angles_deg: one for each frame [deg].
            spec: of the pipeline.

        Raises:
            ConfigurationError: without a flat frame, a bent one, or an angle for each.
            FrameError: for a frame of another sensor, table or frequency.
            DataError: for an angle that is not finite.
        """
        angles = np.asarray(angles_deg, dtype=float).reshape(-1)
        if len(angles) != len(frames):
            raise ConfigurationError(
                f"calibration needs one angle for each frame, got {len(angles)} angles and "
                f"{len(frames)} frames"
            )
        if not np.isfinite(angles).all():
            raise DataError("calibration needs finite angles in degrees, got NaN or infinity")
        flat = np.abs(angles) <= FLAT_DEG
        if not flat.any() or flat.all():
            raise ConfigurationError(
                "calibration needs at least one frame of the flat sensor (0 deg) and one of the "
                f"bent sensor, got {int(flat.sum())} and {int((~flat).sum())}"
            )
        values = np.log(np.abs([spec.voltages(frame)[0] for frame in frames]))
        with warnings.catch_warnings():  # a measurement bad in every flat frame stays NaN
            warnings.simplefilter("ignore", RuntimeWarning)
            reference = np.nanmean(values[flat], axis=0)
        spec.require_same_sensor(np.exp(reference).astype(np.complex128))
        time = np.array([frame.time for frame in frames])
        return cls(
            np.exp(reference),
            int(flat.sum()),
            angles[~flat],
            values[~flat] - reference,
            np.maximum(time[~flat] - time[flat].min(), 0.0),
        )


@dataclass(frozen=True, slots=True)
class Calibration:
    """Result of a calibration: errors of the angle before and after.

    Attributes:
        angles_deg: angles at which standard errors are stated [deg].
        error_before_deg: standard error of one frame's angle before calibration [deg].
        error_after_deg: standard error of one frame's angle after calibration [deg].
        residual_deg: root mean square of estimated minus known angles of the calibration frames,
            after calibration [deg].
    """

    angles_deg: tuple[float, ...]
    error_before_deg: tuple[float, ...]
    error_after_deg: tuple[float, ...]
    residual_deg: float

    def require_fit(self, known: KnownBends) -> None:
        """Refuse known angles that contradict the frames; raises DataError.

        With the shipped pipeline and a simulated sensor, at -20 to 50 deg, the residual is 0.2 deg;
        with angles of the other sign 12 deg, in another order 21 deg, with a sensor that
        stayed flat 28 deg.
        """
        size = float(np.sqrt(np.mean(known.angle_deg**2)))
        allowed = max(LEAST_ALLOWED_DEG, LARGEST_RESIDUAL * size)
        if self.residual_deg > allowed:
            raise DataError(
                f"the frames do not fit their angles: {self.residual_deg:.3g} deg off, root mean "
                f"square, after calibration, expected up to {allowed:.3g} deg for angles of "
                f"{known.angle_deg.min():g} to {known.angle_deg.max():g} deg; check that they are "
                "in degrees, of the right sign and order, and that the sensor was bent by them, "
                "still and untouched"
            )

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        values = {name: getattr(self, name) for name in self.__slots__}
        return {name: list(v) if isinstance(v, tuple) else v for name, v in values.items()}
