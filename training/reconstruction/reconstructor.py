"""Reconstructor: images of the conductivity change of any design under any protocol."""

from functools import cached_property
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.errors import ConfigurationError, FrameError
from eitskin.extras import old_names
from eitskin.frame import Frame
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol
from eitskin.simulator.electrical.forward_model import ForwardModel
from eitskin.simulator.electrical.resolution import Discretisation, Resolution
from eitskin.training.method.input_spec import MIN_CHANNELS, require_usable, usable_values
from eitskin.training.method.observations import relative_difference
from eitskin.training.reconstruction.pixel_grid import PIXELS, LinearModel, PixelGrid, linear_model
from eitskin.training.reconstruction.regularised_inverse import (
    Prior,
    Regularisation,
    RegularisedInverse,
    desired_radius,
    gauss_newton,
    greit,
    least_variation,
    noser_weights,
    prior_matrix,
)

Array = NDArray[np.float64]
Method = Literal["back-projection", "tikhonov", "noser", "laplace", "total-variation", "greit"]
Difference = Literal["relative", "absolute"]

CLEAR = 0.02  # of channels' root mean square, above which relative differences are the default
MAX_SMALL = 0.01  # share of the channels of a reference that are smaller than that
REGION_METHOD: Method = "laplace"
REGION_RULE = "snr:300"
"""Of images that regions are found in: thresholds find their edges, so that they may be smooth."""
MIRROR_CORRELATION = 0.995  # correlation of the readings of two changes that count as the same
VISIBLE = 3.0  # standard deviations of noise, above which a value of a picture says something
MIN_STILL_FRAMES = 5  # frames of one state, from which noise is read
MEDIAN_SHARE = 0.6745  # median of the sizes of a normal deviate, in standard deviations
# resistance of a channel, relative to the mean, that relative differences allow
MIN_RELATIVE_RESISTANCE = 1e-3


@old_names(lambda_of="choose_lambda", mirrored="ambiguous_share")
class Reconstructor:
    """Images of the relative change of conductivity between two frames, without training.

    To first order in the change, data are y = J x for the image x. The methods:

    - back-projection: x_p = (J^T y)_p / (J^T J)_pp, sensitivities projected back (Kotre 1989),
      scaled so that a change of the whole sensor is shown by its size in the mean.
    - tikhonov, noser, laplace: one-step Gauss-Newton, with the prior of that name.
    - total-variation: minimum total variation at the misfit of the laplace image.
    - greit: trained on simulated targets (Adler et al. 2009).

    Attributes:
        design: the nominal sensor; of a model, its body.
        protocol: protocol of the frames.
        method: name of the method.
        regularisation: rule for lambda; back-projection has none.
        difference: "relative" or "absolute".
        resolution: resolution of the forward model.
        grid: pixels of the images.

    Example:
        >>> from eitskin import Protocol, Reconstructor, SensorDesign
        >>> design, protocol = SensorDesign.reference(), Protocol.adjacent(8)
        >>> maker = Reconstructor(design, protocol, "noser", pixels=400)
        >>> maker.grid.shape
        (13, 32)
    """

    def __init__(
        self,
        design: SensorDesign | ForwardModel,
        protocol: Protocol | None = None,
        method: Method = "greit",
        regularisation: Regularisation | None = None,
        pixels: int = PIXELS,
        difference: Difference | None = None,
        resolution: Resolution | Discretisation = "fast",
    ) -> None:
        """Check what is given; the forward model is solved for the first image.

        Args:
            design: the nominal sensor, with a plane outline, or a model of any body, such as of a
                mesh (`ForwardModel.from_mesh`), which is pictured from above.
            protocol: protocol of the frames; every pair of electrodes when omitted.
            method: its name.
            regularisation: rule for lambda; a noise figure of 1 when omitted.
            pixels: approximate number in the outline's bounding box.
            difference: "relative": of each channel, whose gain cancels; "absolute": of all channels
                on one scale, for protocols with channels near zero. When omitted, relative where no
                channel of the model is below a fiftieth of their root mean square.
            resolution: resolution of the forward model.

        Raises:
            ConfigurationError: for a protocol of other electrodes, an unknown method or difference,
                a surface, or a number of pixels that is out of range.
        """
        own = design if isinstance(design, SensorDesign) else design.design
        electrodes = len(own.electrodes)
        self.design: SensorDesign = own
        self._modelled = design
        self.protocol = protocol or Protocol.pairwise(electrodes)
        if self.protocol.n_electrodes != electrodes:
            raise ConfigurationError(
                f"expected a protocol of {electrodes} electrodes, those of the design, got one of "
                f"{self.protocol.n_electrodes}; name a protocol of this sensor"
            )
        self.method = method
        self.regularisation = regularisation or Regularisation()
        self._difference = difference
        for name, value, kind in (
            ("method", method, Method),
            ("difference", difference, Difference),
        ):
            if value not in (*get_args(kind), *([None] if kind is Difference else [])):
                raise ConfigurationError(
                    f"expected a {name} of {', '.join(get_args(kind))}, got {value!r}"
                )
        self.resolution: Resolution | Discretisation = resolution
        self.grid = PixelGrid.from_outline(own.outline, pixels)

    @cached_property
    def model(self) -> LinearModel:
        """Linear model of the flat sensor, for all pixels of the bounding box."""
        return linear_model(
            self._modelled, self.protocol, self.grid.shape, resolution=self.resolution
        )

    @cached_property
    def difference(self) -> Difference:
        """Difference that is pictured: relative, or absolute."""
        if self._difference or all(row[:2] == row[2:] for row in self.protocol.table):
            return self._difference or "relative"
        R = np.abs(np.real(self.model.impedance))[~self._uses_driven_electrode]
        return "relative" if R.min() > CLEAR * np.sqrt(np.mean(R**2)) else "absolute"

    @cached_property
    def _uses_driven_electrode(self) -> NDArray[np.bool_]:
        """Measurements with a driven electrode, whose contact says most, next to those without."""
        shared = np.array(self.protocol.shares)
        return shared & ~shared.all()

    @cached_property
    def ambiguous_share(self) -> float:
        """Share of the pixels whose change looks like that of one far away, 0 to 1.

        So it is where protocol and sensor look the same from both: where opposite electrodes drive
        and opposite ones sense, a change at r reads as one at -r.
        """
        J, centres = self.jacobian[~self._uses_driven_electrode], self.grid.centres
        some = np.unique(np.linspace(0, len(self.grid) - 1, 600).astype(int))
        columns = J[:, some] / np.maximum(np.linalg.norm(J[:, some], axis=0), 1e-300)
        all_columns = J / np.maximum(np.linalg.norm(J, axis=0), 1e-300)
        far = np.linalg.norm(centres[some, None] - centres, axis=2) > 0.25 * np.ptp(centres[:, 0])
        return float(((columns.T @ all_columns > MIRROR_CORRELATION) & far).any(axis=1).mean())

    @cached_property
    def jacobian(self) -> Array:
        """Jacobian J (measurements, P) of the data by the log conductivity of the pixels inside.

        Raises ConfigurationError for relative differences of channels near zero.
        """
        R = np.real(self.model.impedance)
        scale = float(np.sqrt(np.mean(R[~self._uses_driven_electrode] ** 2)))
        if self.difference == "absolute":
            return self.grid.sum_pixels(np.real(self.model.sensitivity)) / scale
        small = (np.abs(R) < MIN_RELATIVE_RESISTANCE * scale) & ~self._uses_driven_electrode
        if small.any():
            labels = [self.protocol.labels[k] for k in np.flatnonzero(small)[:3]]
            raise ConfigurationError(
                f"expected channels away from zero for relative differences, got {small.sum()} "
                f"near it, such as {', '.join(labels)}; take absolute differences"
            )
        return self.grid.sum_pixels(self.model.relative)

    def data(self, impedance: ArrayLike, reference: ArrayLike) -> Array:
        """Data y (..., measurements) of frames against a reference, dimensionless; NaN where bad.

        Absolute differences are divided by the factor, fitted by least squares, that takes the
        model's resistances to the reference, and by their root mean square. Magnitudes alone, which
        are never negative, have the signs of the model's resistances.

        Args:
            impedance: impedance of the frames (..., measurements), in any unit.
            reference: the same sensor before the change (..., measurements), in the same unit.

        Raises:
            FrameError: for another number of measurements.
        """
        V, before = np.asarray(impedance), np.asarray(reference)
        for values in (V, before):
            self._require_measurements(values)
        before = np.where(self._uses_driven_electrode, np.nan, before)
        if self.difference == "relative":
            with np.errstate(divide="ignore"):
                change = relative_difference(V, before)
            return np.where(np.isfinite(change), change, np.nan)
        R = np.real(self.model.impedance)
        if not any(np.imag(values).any() or (np.real(values) < 0).any() for values in (V, before)):
            V, before = V * np.sign(R), before * np.sign(R)
        finite = np.isfinite(before)
        gain = np.sum(np.where(finite, np.conj(before), 0) * R, axis=-1, keepdims=True)
        gain = gain / np.sum(np.where(finite, R**2, 0.0), axis=-1, keepdims=True)
        with np.errstate(invalid="ignore", divide="ignore"):
            change = np.real((V - before) / np.conj(gain))
        scale = float(np.sqrt(np.mean(R[~self._uses_driven_electrode] ** 2)))
        return np.where(np.isfinite(change), change, np.nan) / scale

    def image(self, frame: Frame, reference: Frame) -> Array:
        """Image (rows, columns) of a frame against a reference frame; NaN outside the outline.

        Values are relative changes of conductivity, dimensionless. Bad channels are left out.

        Raises:
            FrameError: for a frame of another protocol.
            UnusableFrameError: for a frame with too few good channels.
        """
        for each in (frame, reference):
            self.require_same_protocol(each)
        V, before = (usable_values(each)[0] for each in (frame, reference))
        return self.images(self.data(V, before))

    def require_same_protocol(self, frame: Frame) -> None:
        """Refuse a frame of another protocol; raises FrameError."""
        self.protocol.require_same(
            frame.protocol,
            "the pictures are those of",
            "the frame has",
            "name the protocol of the board or recording",
        )

    def _require_measurements(self, values: NDArray[np.generic]) -> None:
        if values.shape[-1:] != (len(self.protocol),):
            raise FrameError(
                f"expected values of the {len(self.protocol)} measurements of {self.protocol}, got "
                f"shape {values.shape}; name the protocol of the board or recording"
            )

    def images(self, data: ArrayLike) -> Array:
        """Images (..., rows, columns) of data (..., measurements); NaN outside the outline.

        Channels that are NaN in a frame are left out of its image. Half as many must be good as are
        independent of each other.

        Raises:
            FrameError: for another number of measurements.
            UnusableFrameError: for a frame with too few good channels.
        """
        y = np.asarray(data, dtype=float)
        self._require_measurements(y)
        frames = y.reshape(-1, y.shape[-1])
        missing, group = np.unique(np.isnan(frames), axis=0, return_inverse=True)
        values = np.empty((len(frames), len(self.grid)))
        for number, channels in enumerate(missing):
            few = np.mean(~channels) < MIN_CHANNELS
            if few and np.sum(~channels) < MIN_CHANNELS * self.protocol.rank:
                require_usable(~channels)
            mine = group.ravel() == number
            values[mine] = self._values(frames[mine][:, ~channels], channels)
        return self.grid.image(values.reshape(*y.shape[:-1], -1))

    def noise(self, data: ArrayLike) -> Array:
        """Standard deviation (rows, columns) of images by noise alone; NaN outside the outline.

        The noise is that of the difference of two frames, as `data` (n, measurements) of an
        unchanged sensor show it from each to the next; for total variation, that of its laplace
        image. NaN for fewer than five frames, and where frames choose lambda (gcv).
        """
        frames = np.atleast_2d(np.asarray(data, dtype=float))
        missing = np.isnan(frames).all(axis=0)
        steps = np.diff(frames[:, ~missing], axis=0)
        steps = steps[np.isfinite(steps).all(axis=1)]
        if len(steps) < MIN_STILL_FRAMES - 1 or self.regularisation.rule == "gcv":
            return self.grid.image(np.full(len(self.grid), np.nan))
        changes = self._linear_values(steps, missing)
        return self.grid.image(np.median(np.abs(changes), axis=0) / MEDIAN_SHARE)

    def choose_lambda(self, data: ArrayLike | None = None) -> float:
        """Regularisation parameter lambda of the rule; data (n, measurements) are for gcv.

        Raises ConfigurationError for a noise figure that no lambda has, and for back-projection.
        """
        used = ~self._uses_driven_electrode
        frames = np.zeros((1, len(self.protocol))) if data is None else np.atleast_2d(data)
        family = self.family if used.all() else self.family.drop_channels(~used)
        return self.regularisation.choose(family, self.response[used], frames[:, used])

    @cached_property
    def family(self) -> RegularisedInverse:
        """Reconstruction matrices of the method over lambda; those of laplace for total variation.

        Raises ConfigurationError for back-projection, which has one matrix.
        """
        if self.method == "greit":
            radius = desired_radius(self.grid, self.protocol.rank)
            return greit(self.grid, self.jacobian, radius)
        if self.method == "back-projection":
            raise ConfigurationError("expected a method with regularisation, got back-projection")
        prior: Prior = "laplace" if self.method == "total-variation" else self.method
        return gauss_newton(self.jacobian, prior_matrix(prior, self.grid, self.jacobian))

    @cached_property
    def response(self) -> Array:
        """Data of a target of one pixel in the middle, to which noise figures refer (M,)."""
        response: Array = self.jacobian[:, self.grid.middle]
        return response

    @cached_property
    def _lambda(self) -> float:
        """Regularisation parameter lambda of rules that need no frames."""
        return self.choose_lambda()

    def _values(self, frames: Array, missing: NDArray[np.bool_]) -> Array:
        """Values (n, P) of frames (n, good measurements) that all lack the `missing` channels."""
        values = self._linear_values(frames, missing)
        if self.method != "total-variation":
            return values
        J = self.jacobian[~missing]
        misfits = np.linalg.norm(frames - values @ J.T, axis=1)
        both = zip(frames, misfits.tolist(), strict=True)
        return np.array([least_variation(self.grid, J, y, misfit) for y, misfit in both])

    def _linear_values(self, frames: Array, missing: NDArray[np.bool_]) -> Array:
        """Values as `_values` gives them; of total variation those that it begins with."""
        if self.method == "back-projection":
            return frames @ back_projection(self.jacobian[~missing]).T
        family = self.family.drop_channels(missing) if missing.any() else self.family
        if self.regularisation.rule == "gcv":
            matrix = family.matrix(family.lambda_from_gcv(frames))
        else:
            matrix = family.matrix(self._lambda) if missing.any() else self._whole_matrix
        values: Array = frames @ matrix.T
        return values

    @cached_property
    def _whole_matrix(self) -> Array:
        """Reconstruction matrix (P, measurements) of frames without missing channels."""
        return self.family.matrix(self._lambda)


def back_projection(jacobian: Array) -> Array:
    """Matrix (P, measurements) that projects sensitivities back: (J^T y)_p / (J^T J)_pp, scaled.

    The scale is one for all pixels: a uniform change has the mean value of its size. Pixels that
    hardly any current passes have the floor of `noser_weights`.
    """
    matrix = (jacobian / noser_weights(jacobian)).T
    return matrix / float(np.mean(matrix @ jacobian.sum(axis=1)))


def suited_difference(protocol: Protocol, reference: NDArray[np.inexact]) -> Difference | None:
    """Absolute where channels (..., C) of a measured reference are near zero; None elsewhere.

    Noise and misfit of the sensor are large next to such channels, though its model has none.
    Channels with a driven electrode, next to others without, do not count, nor does one in a
    hundred.
    """
    shared = np.array(protocol.shares)
    if reference.shape[-1:] != shared.shape:
        return None
    sizes = np.abs(reference)[..., ~shared | shared.all()]
    sizes = sizes[np.isfinite(sizes) & (sizes > 0)]
    small = sizes <= CLEAR * np.sqrt(np.mean(sizes**2))
    return "absolute" if len(sizes) and small.mean() > MAX_SMALL else None


def silent_channels(impedance: NDArray[np.inexact]) -> NDArray[np.bool_]:
    """Channels (C,) that are zero in all frames (n, C), or never change while most others do."""
    still = np.ptp(np.abs(impedance), axis=0) == 0
    dead = np.max(np.abs(impedance), axis=0) <= 1e-9 * np.max(np.abs(impedance))
    stuck = still & (len(impedance) > 4) & (np.mean(still) < 0.5)
    return np.asarray(dead | stuck)
