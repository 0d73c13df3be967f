"""Input specification of a pipeline: sensor, protocol and units; refusal of other frames."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.bounds import LARGEST_READING, LEAST_READING
from eitskin.config import from_dict, to_dict
from eitskin.datasets.store.dataset import Dataset
from eitskin.errors import DataError, FrameError, UnusableFrameError
from eitskin.frame import Frame
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol
from eitskin.training.method.symmetry import electrode_orders

FREQUENCY_TOLERANCE = 0.01  # relative
LARGEST_SCALE = 5.0  # factor common to all values; gels scatter by less, wrong units by more
LARGEST_SPREAD = 0.10  # of log ratios; contacts that scatter by 50 % give 0.07, wrong wiring 0.15
# Readings of neighbours depend far more on the places of electrodes: between 32 on a rim they
# scatter by 0.12 where these do by 0.5 mm, and wrong wiring gives 1.
SPREAD_MARGIN = 1.5  # times the largest spread of the specimens trained with
WIDEST_SPREAD = 0.5
EXCHANGED = 0.5  # share of the scatter that another order of the electrodes leaves of a wrong one
SMALL = 0.1  # of the rms of all values, below which a channel counts less
PIXELS = 2560  # of a map; on the reference sensor 32 x 80 squares of 1.875 mm
FEWEST_CHANNELS = 0.5  # share of a frame that must be usable


@dataclass(frozen=True, slots=True, eq=False)
class InputSpec:
    """Sensor, measurements and units that a pipeline was trained for.

    Attributes:
        design: the nominal sensor.
        protocol: the table of measurements.
        frequency: of the excitation [Hz].
        reference: magnitudes of the flat, untouched sensor (measurements,) [ohm]; median over the
            specimens trained with.
        spread: largest root mean square of the logarithms of a sensor's magnitudes over
            `reference`, less a common factor, that is taken for a sensor of this design.
    """

    design: SensorDesign
    protocol: Protocol
    frequency: float
    reference: NDArray[np.float64]
    spread: float = LARGEST_SPREAD

    @classmethod
    def of(cls, dataset: Dataset, design: SensorDesign, protocol: Protocol) -> "InputSpec":
        """Specification for the sensors of a training set."""
        magnitudes = np.abs(dataset.reference[np.unique(dataset.specimen)]).astype(float)
        reference = np.median(magnitudes, axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = np.log(magnitudes / reference)
        weights = _weights(reference)
        known = [np.isfinite(each) for each in logs]
        found = [_spread(each[k], weights[k])[0] for each, k in zip(logs, known, strict=True)]
        spread = min(max(LARGEST_SPREAD, SPREAD_MARGIN * max(found)), WIDEST_SPREAD)
        return cls(design, protocol, dataset.frequency, reference, spread)

    def document(self) -> dict[str, Any]:
        """Plain data for JSON, without `reference`."""
        return {
            "design": to_dict(self.design),
            "protocol": asdict(self.protocol),
            "frequency": self.frequency,
            "spread": self.spread,
            "units": {"impedance": "ohm", "frequency": "Hz", "length": "m", "angle": "degree"},
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any], reference: NDArray[Any]) -> "InputSpec":
        """Restore the specification.

        Raises ConfigurationError or DataError for values that no training gives.
        """
        design = from_dict(SensorDesign, document["design"], "layout.design")
        protocol = from_dict(Protocol, document["protocol"], "layout.protocol")
        frequency, spread = float(document["frequency"]), document.get("spread", LARGEST_SPREAD)
        if reference.shape != (len(protocol),) or not np.all(reference >= 0) or not reference.any():
            raise DataError(
                f"expected {len(protocol)} magnitudes of the flat sensor, got an array of shape "
                f"{reference.shape} or others than positive numbers; train the pipeline again"
            )
        if not (0 < frequency < np.inf and 0 < float(spread) <= WIDEST_SPREAD):
            raise DataError(
                f"expected a frequency and a spread of up to {WIDEST_SPREAD:g}, got {frequency:g} "
                f"Hz and {float(spread):g}; train the pipeline again"
            )
        return cls(design, protocol, frequency, reference.astype(float), float(spread))

    @property
    def outline(self) -> tuple[float, float]:
        """Length and width of the sensor [m]."""
        return self.design.outline.length, self.design.outline.width

    @property
    def pixels(self) -> tuple[int, int]:
        """Rows and columns of maps: about `PIXELS` squares, multiples of eight for the networks."""
        length, width = self.outline
        side = (length * width / PIXELS) ** 0.5
        rows, columns = (8 * max(1, round(extent / side / 8)) for extent in (width, length))
        return rows, columns

    def voltages(self, frame: Frame) -> tuple[NDArray[np.complex128], tuple[str, ...]]:
        """Values of a frame (measurements,) [ohm], NaN where bad, and its problems in words.

        Raises:
            FrameError: for a frame of another protocol or frequency.
            UnusableFrameError: for a frame with too few good channels.
        """
        self.require_same_measurements(frame.protocol, frame.frequency)
        return usable_values(frame)

    def require_same_measurements(self, protocol: Protocol, frequency: float) -> None:
        """Refuse a protocol or frequency [Hz] other than the trained one; raises FrameError."""
        self.protocol.require_same(
            protocol,
            "this pipeline was trained for",
            "the frames have",
            "set the board to the first, or train a pipeline for the second",
        )
        if abs(frequency / self.frequency - 1.0) > FREQUENCY_TOLERANCE:
            raise FrameError(
                f"this pipeline was trained at {self.frequency:g} Hz, the frames were measured "
                f"at {frequency:g} Hz; set the board to that frequency"
            )

    def of_sensor(self, flat: NDArray[np.float64]) -> "InputSpec":
        """Specification for one sensor of this design.

        Args:
            flat: its magnitudes, flat and untouched (measurements,) [ohm]; NaN where unknown.
        """
        known = np.isfinite(flat) & (flat > 0)
        common = np.median(flat[known] / self.reference[known])
        return replace(self, reference=np.where(known, flat, common * self.reference))

    def require_same_sensor(self, voltages: NDArray[np.complex128]) -> None:
        """Refuse a first frame (measurements,) [ohm] of another sensor; raises FrameError.

        The median of the log ratios to the trained reference is a common factor, the gel's
        conductivity or the board's gain; `LARGEST_SCALE` limits it. The remainder is due to
        contacts and geometry; `spread` limits its root mean square. (A median would
        overlook two swapped electrodes, which leave most channels unchanged.) Where another order
        of the electrodes leaves far less, that is the reason.
        """
        self._require_like(
            voltages,
            self.spread,
            "make the pipeline its own by known angles (eitskin calibrate, eitskin adapt)",
        )

    def require_adaptable(self, voltages: NDArray[np.complex128]) -> None:
        """Refuse a flat frame (measurements,) [ohm] that is not of this design; raises FrameError.

        Known frames make a pipeline that of a sensor whose contacts and electrodes differ by more
        than those trained with, so `WIDEST_SPREAD` is the limit here.
        """
        self._require_like(
            voltages,
            WIDEST_SPREAD,
            "train a pipeline for it (own frames go together with simulated ones: eitskin dataset "
            "combine)",
        )

    def _require_like(self, voltages: NDArray[np.complex128], limit: float, remedy: str) -> None:
        known = np.flatnonzero(np.isfinite(voltages))
        logs = np.log(np.abs(voltages[known] / self.reference[known]))
        spread, common = _spread(logs, _weights(self.reference)[known])
        worst = self.protocol.labels[known[np.abs(logs - common).argmax()]]
        if abs(common) > np.log(LARGEST_SCALE):
            raise FrameError(
                f"values are {np.exp(common):.3g} times those of the sensor this pipeline was "
                f"trained for (expected {1 / LARGEST_SCALE:g} to {LARGEST_SCALE:g}): another "
                "sensor, or other units than ohm; train a pipeline for it"
            )
        if spread > LARGEST_SPREAD and (other := self._other_order(voltages, spread)):
            raise FrameError(
                f"the channels scatter by {spread:.1%} against the sensor this pipeline was "
                f"trained for, and by {other}: they are in another order; plug them in that of the "
                "design"
            )
        if spread > limit:
            raise FrameError(
                f"the channels scatter by {spread:.1%} against the sensor this pipeline was "
                f"trained for (expected up to {limit:.1%}, after one common factor of "
                f"{np.exp(common):.3g}), most of all {worst}: another sensor, a board that loads "
                "it otherwise, a bad contact, or electrodes in another order; check the wiring, or "
                f"{remedy}"
            )

    def _other_order(self, voltages: NDArray[np.complex128], spread: float) -> str:
        """Order of the electrodes that leaves far less than `spread`, in words; empty for none."""
        weights, best, words = _weights(self.reference), EXCHANGED * spread, ""
        for name, order in electrode_orders(self.protocol):
            logs = np.log(np.abs(voltages[order]) / self.reference)
            known = np.isfinite(logs)
            if (left := _spread(logs[known], weights[known])[0]) < best:
                best, words = left, f"{left:.1%} with {name}"
        return words


def _weights(reference: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights of channels (m,): smaller values than a tenth of the rms are mostly noise."""
    share = reference / (SMALL * float(np.sqrt(np.mean(reference**2))))
    weights: NDArray[np.float64] = np.minimum(share, 1.0) ** 2
    return weights


def _spread(logs: NDArray[np.float64], weights: NDArray[np.float64]) -> tuple[float, float]:
    """Weighted root mean square of log ratios (m,) about their median, and that median.

    0 without any.
    """
    if not logs.size:
        return 0.0, 0.0
    common = float(np.median(logs))
    return float(np.sqrt(np.average((logs - common) ** 2, weights=weights))), common


def usable_values(frame: Frame) -> tuple[NDArray[np.complex128], tuple[str, ...]]:
    """Values of a frame (measurements,) [ohm], NaN where bad, and its problems in words.

    Raises UnusableFrameError for a frame with too few good channels.
    """
    size = np.abs(frame.impedance)
    # Others are no readings, and their squares would overflow.
    good = (LEAST_READING <= size) & (size <= LARGEST_READING) & (frame.status == 0)
    labels = frame.protocol.labels
    problems = tuple(
        f"channel {labels[i]} is left out: "
        + (f"board status {frame.status[i]}" if frame.status[i] else f"{frame.impedance[i]}")
        for i in np.flatnonzero(~good)
    )
    require_usable(good, *problems[:1])
    return np.where(good, frame.impedance, np.nan), problems


def require_usable(good: NDArray[np.bool_], *problems: str) -> None:
    """Refuse a frame with too few good channels (measurements,); raises UnusableFrameError.

    Args:
        good: whether each channel is usable.
        problems: of the channels, for the message.
    """
    if good.mean() < FEWEST_CHANNELS:
        count = f"got {good.sum()} of {good.size}"
        raise UnusableFrameError(
            f"expected at least {FEWEST_CHANNELS:.0%} usable channels, "
            + "; ".join([count, *problems, "check the cable and the electrodes"])
        )
