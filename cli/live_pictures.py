"""Pipelines of the live loop that make pictures without training, alone or next to another one."""

import math
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from eitskin import hardware
from eitskin.errors import ConfigurationError, UnusableFrameError
from eitskin.frame import Frame
from eitskin.training.method.input_spec import usable_values
from eitskin.training.reconstruction.reconstructor import Method, Reconstructor

Array = NDArray[np.float64]

REFERENCE = 16  # first frames of a session, untouched, whose mean is the reference
CALM = 6.0  # least end of the colour scale, over the standard deviation of an untouched picture


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """Picture of one frame, with its colour scale.

    Attributes:
        values: relative change of conductivity (rows, columns), dimensionless; NaN outside.
        limit: magnitude at both ends of the colour scale.
    """

    values: Array
    limit: float


@dataclass(frozen=True, slots=True, eq=False)
class PictureEstimate:
    """Estimate of a live loop that only makes pictures.

    Attributes:
        state: "picture", or how much of the reference is there.
        picture: None while the reference is taken.
        touch_map: share of the colour scale by which pixels conduct less (rows, columns), 0 to 1.
        problems: none.
    """

    state: str
    picture: Picture | None
    touch_map: Array
    probabilities: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    bend_angle_deg: None = None
    touches: None = None
    problems: tuple[str, ...] = ()


class LivePictures:
    """Pipeline of pictures of a session's frames against the mean of its first ones.

    Attributes:
        maker: maker of the pictures.
        taken: number of frames in the session's reference so far, at most `REFERENCE`.
    """

    def __init__(
        self, maker: Reconstructor, pipeline: "hardware.FramePipeline | None" = None
    ) -> None:
        """Solve the sensor's linear model, so that no frame has to wait for that.

        Args:
            maker: maker of the pictures.
            pipeline: another pipeline, whose estimates carry the pictures as `picture`.
        """
        if maker.method == "total-variation":
            linear = ", ".join(each for each in get_args(Method) if each != maker.method)
            raise ConfigurationError(
                f"total variation takes seconds for a picture; name one of {linear} for live ones"
            )
        self.maker, self.taken, self._pipeline = maker, 0, pipeline
        self._session: int | None = None
        self._first: list[NDArray[np.complex128]] = []
        self._reference = np.zeros(0, np.complex128)
        self._floor = 0.0
        maker.images(np.zeros(len(maker.protocol)))

    def process(self, frame: Frame) -> Any:
        """Picture of `frame`, as an estimate or with that of the other pipeline."""
        if self._pipeline is not None:
            estimate = self._pipeline.process(frame)
            try:
                return _PictureMethod(estimate, self.picture(frame))
            except UnusableFrameError:
                return estimate
        picture = self.picture(frame)
        if picture is None:
            state = f"reference {self.taken}/{REFERENCE}"
            return PictureEstimate(state, None, np.zeros(self.maker.grid.shape))
        less = np.clip(-np.nan_to_num(picture.values) / picture.limit, 0.0, 1.0)
        return PictureEstimate("picture", picture, less)

    def picture(self, frame: Frame) -> Picture | None:
        """Picture of a frame; None while frames still go into the reference.

        Raises FrameError for a frame of another protocol, UnusableFrameError for one with too few
        good channels.
        """
        self.maker.require_same_protocol(frame)
        if frame.session != self._session:
            self._session, self.taken, self._first = frame.session, 0, []
        values, _ = usable_values(frame)
        if self.taken < REFERENCE:
            self._first.append(values)
            self.taken += 1
            if self.taken == REFERENCE:
                self._finish_reference()
            return None
        picture = self.maker.images(self.maker.data(values, self._reference))
        return Picture(picture, max(self._floor, float(np.nanmax(np.abs(picture)))) or 1.0)

    def _finish_reference(self) -> None:
        """Mean of the first frames, and the noise of their pictures."""
        first = np.ma.masked_invalid(self._first)
        self._reference = first.mean(axis=0).filled(np.nan)
        data = self.maker.data(np.array(self._first), self._reference)
        noise = self.maker.images(np.where(np.isfinite(data), data, 0.0))
        self._floor = CALM * float(np.sqrt(np.nanmean(noise**2)))


class _PictureMethod:
    """An estimate with a picture; all else is that of the estimate."""

    def __init__(self, estimate: Any, picture: Picture | None) -> None:
        self._estimate, self.picture = estimate, picture

    def __getattr__(self, name: str) -> Any:
        return getattr(self._estimate, name)
