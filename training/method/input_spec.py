"""What a pipeline was trained for, and the refusal of frames of anything else."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.config import from_dict, to_dict
from eitskin.errors import FrameError, UnusableFrameError
from eitskin.frame import Frame
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol

FREQUENCY_TOLERANCE = 0.01  # relative
LARGEST_SCALE = (
    5.0  # of values over those trained with; gels scatter by less, boards' units by more
)
LARGEST_SPREAD = 0.10  # of log ratios; contacts that scatter by 50 % give 0.07, wrong wiring 0.15
PIXELS = 2560  # of a map; on the reference sensor 32 x 80 squares of 1.875 mm
FEWEST_CHANNELS = 0.5  # share of a frame that must be usable


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """Sensor, measurements and units that a pipeline was trained for.

    Attributes:
        design: the nominal sensor.
        protocol: the table of measurements.
        frequency: of the excitation [Hz].
        reference: magnitudes of the flat, untouched sensor, the median of the specimens trained
            with, (measurements,) [ohm].
    """

    design: SensorDesign
    protocol: Protocol
    frequency: float
    reference: NDArray[np.float64]

    def document(self) -> dict[str, Any]:
        """All but `reference` as JSON takes it."""
        return {
            "design": to_dict(self.design),
            "protocol": asdict(self.protocol),
            "frequency": self.frequency,
            "units": {"impedance": "ohm", "frequency": "Hz", "length": "m", "angle": "degree"},
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any], reference: NDArray[Any]) -> "Layout":
        """The layout that `document` came from; raises ConfigurationError where it does not fit."""
        design = from_dict(SensorDesign, document["design"], "layout.design")
        protocol = from_dict(Protocol, document["protocol"], "layout.protocol")
        return cls(design, protocol, float(document["frequency"]), reference.astype(float))

    @property
    def outline(self) -> tuple[float, float]:
        """Length and width of the sensor [m]."""
        return self.design.outline.length, self.design.outline.width

    @property
    def pixels(self) -> tuple[int, int]:
        """Rows and columns of maps: about `PIXELS` square ones, multiples of eight for networks."""
        length, width = self.outline
        side = (length * width / PIXELS) ** 0.5
        rows, columns = (8 * max(1, round(extent / side / 8)) for extent in (width, length))
        return rows, columns

    def voltages(self, frame: Frame) -> tuple[NDArray[np.complex128], tuple[str, ...]]:
        """The frame's values, NaN where a channel is bad, and what is bad about it in words.

        Raises FrameError for a frame of another table, electrode count or frequency, or one
        without enough good channels.
        """
        self.require_same_measurements(frame.protocol, frame.frequency)
        good = np.isfinite(frame.impedance) & (frame.status == 0) & (frame.impedance != 0)
        labels = self.protocol.labels
        problems = tuple(
            f"channel {labels[i]} is left out: "
            + (f"board status {frame.status[i]}" if frame.status[i] else f"{frame.impedance[i]}")
            for i in np.flatnonzero(~good)
        )
        if good.mean() < FEWEST_CHANNELS:
            raise UnusableFrameError(
                f"expected at least {FEWEST_CHANNELS:.0%} usable channels, got {good.sum()} of "
                f"{good.size}; {problems[0]}; check the cable and the electrodes"
            )
        return np.where(good, frame.impedance, np.nan), problems

    def require_same_measurements(self, protocol: Protocol, frequency: float) -> None:
        """Refuse measurements other than those trained with; raises FrameError."""
        if protocol.n_electrodes != self.protocol.n_electrodes:
            raise FrameError(
                f"this pipeline was trained for {self.protocol.n_electrodes} electrodes, the "
                f"frame has {protocol.n_electrodes}; train a pipeline for this sensor"
            )
        if protocol.table != self.protocol.table:
            raise FrameError(
                f"this pipeline was trained for a table of {len(self.protocol)} measurements "
                f"starting with {self.protocol.labels[:3]}, the frame has {len(protocol)} starting "
                f"with {protocol.labels[:3]} or in another order; set the board to that table"
            )
        if abs(frequency / self.frequency - 1.0) > FREQUENCY_TOLERANCE:
            raise FrameError(
                f"this pipeline was trained at {self.frequency:g} Hz, the frame was measured at "
                f"{frequency:g} Hz; set the board to that frequency"
            )

    def require_same_sensor(self, voltages: NDArray[np.complex128]) -> None:
        """Refuse a first frame (measurements,) [ohm] that no sensor of this layout gives.

        One factor common to all channels, the median, is the gel's conductivity or the board's
        gain; it may be up to `LARGEST_SCALE`. What remains of the log ratios to the trained
        reference is contacts and geometry; its root mean square may be `LARGEST_SPREAD`. (A
        median of it would not do: two swapped electrodes leave most channels as they were.)
        """
        known = np.flatnonzero(np.isfinite(voltages))
        logs = np.log(np.abs(voltages[known] / self.reference[known]))
        common = float(np.median(logs))
        spread = float(np.sqrt(np.mean((logs - common) ** 2)))
        worst = self.protocol.labels[known[np.abs(logs - common).argmax()]]
        if abs(common) > np.log(LARGEST_SCALE):
            raise FrameError(
                f"values are {np.exp(common):.3g} times those of the sensor this pipeline was "
                f"trained for (expected {1 / LARGEST_SCALE:g} to {LARGEST_SCALE:g}): another "
                "sensor, or other units than ohm; train a pipeline for it"
            )
        if spread > LARGEST_SPREAD:
            raise FrameError(
                f"the channels scatter by {spread:.0%} against the sensor this pipeline was "
                f"trained for (expected up to {LARGEST_SPREAD:.0%}, after one common factor of "
                f"{np.exp(common):.3g}), most of all {worst}: another sensor, a bad contact, or "
                "electrodes in another order; check the wiring, or train a pipeline for it"
            )
