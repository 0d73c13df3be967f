"""Adaptation of a trained pipeline to one sensor: what it was given, and errors before and after.

`Calibration` tells of the bend angle, `TwinTrial` of the response with a twin.
"""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError, DataError
from eitskin.training.method.known_frames import KnownFrames

Array = NDArray[np.float64]

LARGEST_RESIDUAL = 0.25  # relative to the root mean square of the known angles
LEAST_ALLOWED_DEG = 1.0  # residual that is allowed however small the angles


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

    def require_fit(self, known_deg: Array) -> None:
        """Refuse known angles (n,) [deg] that contradict the frames; raises DataError.

        With the shipped pipeline and a simulated sensor, at -20 to 50 deg, the residual is 0.2 deg;
        with angles of the other sign 12 deg, in another order 21 deg, with a sensor that
        stayed flat 28 deg.
        """
        size = float(np.sqrt(np.mean(known_deg**2)))
        allowed = max(LEAST_ALLOWED_DEG, LARGEST_RESIDUAL * size)
        if self.residual_deg > allowed:
            raise DataError(
                f"the frames do not fit their angles: {self.residual_deg:.3g} deg off, root mean "
                f"square, after calibration, expected up to {allowed:.3g} deg for angles of "
                f"{known_deg.min():g} to {known_deg.max():g} deg; check that they are "
                "in degrees, of the right sign and order, and that the sensor was bent by them, "
                "still and untouched"
            )

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return _plain(self)


@dataclass(frozen=True, slots=True)
class TwinTrial:
    """Response to touches without and with a twin, in known touches that the twin is judged by.

    Attributes:
        touches: number of frames with known touches.
        without: residual of their changes by the response as trained, relative to the changes; None
            without such frames.
        with_twin: the same by the twin's response.
    """

    touches: int
    without: float | None = None
    with_twin: float | None = None

    @property
    def kept(self) -> bool:
        """Whether the twin's response is taken: unless known touches contradict it."""
        if self.without is None or self.with_twin is None:
            return True
        return self.with_twin < self.without


@dataclass(frozen=True, slots=True)
class Adaptation:
    """Result of an adaptation to one sensor by known frames.

    Attributes:
        flat: number of frames of the flat, untouched sensor.
        bends: number of untouched frames at known angles that were used.
        touches: number of frames with touches at known places that were used.
        left_out: number of frames that were not used: not enough is known of them, or the method
            has no use for it.
        calibration: errors of the angle; None without known angles.
        error_scale: factor by which known touches changed the standard errors of places; 1 without.
        twin: residuals of known touches without and with a twin; None without one.
        noise_scale: noise of a frame relative to that in training, as far as the known frames tell.
    """

    flat: int
    bends: int = 0
    touches: int = 0
    left_out: int = 0
    calibration: Calibration | None = None
    error_scale: float = 1.0
    twin: TwinTrial | None = None
    noise_scale: float = 1.0

    def require_fit(self, known: KnownFrames) -> None:
        """Refuse frames of which nothing is known, or known angles that contradict the frames.

        Also a twin that nothing was done with. Raises DataError, as `Calibration.require_fit`, and
        ConfigurationError.
        """
        if known.twin is None and not (self.flat or self.bends or self.touches):
            raise DataError(
                "expected frames known to be untouched, or of a known angle or known touches, to "
                f"adapt to, got none among {self.left_out}; label or record some"
            )
        if self.calibration is not None:
            self.calibration.require_fit(known.angle_deg[known.bent])
        if known.twin is not None and self.twin is None:
            raise ConfigurationError(
                "expected a pipeline that knows the forces of touches to take a twin's response "
                "(`--preset joint`), got another one; adapt it without a twin"
            )

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return _plain(self)


def _plain(values: Any) -> dict[str, Any]:
    """Fields of a dataclass and of those in it, with lists for tuples."""
    return asdict(
        values,
        dict_factory=lambda pairs: {
            name: list(value) if isinstance(value, tuple) else value for name, value in pairs
        },
    )
