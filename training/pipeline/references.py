"""References: running means of untouched frames, and those stored in a small JSON file."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.bounds import LARGEST_READING, LEAST_READING, require_axes
from eitskin.config import Location, build
from eitskin.errors import ConfigurationError, DataError
from eitskin.extras import old_names
from eitskin.files import atomic_file, parse_json, read_bytes
from eitskin.frame import Frame
from eitskin.protocol import Protocol
from eitskin.training.method.observations import relative_difference
from eitskin.training.method.predictions import Zero

FORMAT = "eitskin-reference"
FORMAT_VERSION = 1
MAX_FILE = 10_000_000  # bytes; a thousand measurements need 50,000

Voltages = NDArray[np.complex128]

MAX_MEAN_FRAMES = 32  # frames; a longer mean would lag behind a drift too slow to count as motion


@dataclass
class RunningMean:
    """Mean of the frames since the sensor last moved.

    Attributes:
        noise: rms over the channels of the relative difference of two frames of a still sensor.
        mean: complex (measurements,) [ohm], NaN where never measured; size 0 at first.
        count: number of frames in the mean.
        longest: number of frames beyond which the mean becomes exponential.
    """

    noise: float
    mean: Voltages = field(default_factory=lambda: np.zeros(0, np.complex128))
    count: int = 0
    longest: int = MAX_MEAN_FRAMES

    def restart(self, impedance: ArrayLike) -> None:
        """Begin a new mean with this frame (measurements,) [ohm]."""
        self.mean, self.count = np.array(impedance, dtype=np.complex128), 1

    def add(self, impedance: ArrayLike) -> bool:
        """Add one frame (measurements,) [ohm], NaN where a channel is bad.

        Returns whether the sensor moved, which restarts the mean. A still frame differs from the
        mean by at most `noise` rms; twice that counts as motion. With 28 channels, chance exceeds
        this limit less than once in a billion frames.
        """
        V = np.array(impedance, dtype=np.complex128)
        if not self.mean.size:
            self.restart(V)
            return False
        finite = np.isfinite(V) & np.isfinite(self.mean)
        change = relative_difference(V[finite], self.mean[finite])
        departed = bool(change.size and np.sqrt(np.mean(change**2)) > 2 * self.noise)
        self.count = 1 if departed else min(self.count + 1, self.longest)
        step = np.where(finite, (V - self.mean) / self.count, 0)
        only_new = np.isfinite(V) & ~np.isfinite(self.mean)
        self.mean = np.where(only_new, V, self.mean + step)
        return departed


@old_names(of="from_frames")
@dataclass(frozen=True, slots=True, eq=False)
class StoredReference:
    """Mean of untouched frames of one sensor.

    Attributes:
        impedance: (measurements,) [ohm]; NaN where a channel was bad.
        protocol: protocol of the measurements.
        frequency: frequency of the excitation [Hz].
        zero: state of the sensor, `Zero.FLAT` or `Zero.MOUNTED`.
        frames: number of frames in the mean.
        noise: rms of the relative difference of two of the frames; None for a single one.
        taken: time of writing, ISO 8601 with time zone.
        board: unique number of the board in hexadecimal digits; empty where unknown.
        source: URI or path that the frames came from; empty where unknown.

    Example:
        >>> from eitskin import Pipeline, Scene, SensorDesign, Simulator
        >>> pipeline = Pipeline.load("reference.eitmodel")
        >>> pipeline.tare([Simulator(SensorDesign.reference(), "coarse").measure(Scene())]).frames
        1
    """

    impedance: NDArray[np.complex128]
    protocol: Protocol
    frequency: float
    zero: Zero
    frames: int
    noise: float | None
    taken: str
    board: str = ""
    source: str = ""

    @classmethod
    def from_frames(
        cls,
        impedance: Sequence[NDArray[np.complex128]],
        protocol: Protocol,
        frequency: float,
        zero: Zero,
        still: float = math.inf,
        board: str = "",
        source: str = "",
    ) -> "StoredReference":
        """Mean of n frames (n, measurements) [ohm], NaN where a channel is bad, taken now.

        Args:
            impedance: n frames; readings beyond those of all sensors are bad.
            protocol, frequency, zero, board, source: values of the attributes.
            still: rms of the relative difference of two frames of a still sensor; twice that is
                motion.

        Raises:
            ConfigurationError: for no frames.
            DataError: for a sensor that moves, and for frames without a good channel.
        """
        if not len(impedance):
            raise ConfigurationError("expected frames of the untouched sensor, got none; give some")
        values, count = np.asarray(impedance), len(impedance)
        size = np.abs(values)
        values = np.where((size >= LEAST_READING) & (size <= LARGEST_READING), values, np.nan)
        mean = RunningMean(still, longest=count)
        for number, frame in enumerate(values, 1):
            if mean.add(frame):
                raise DataError(
                    f"expected frames of a still sensor, but it moves in frame {number} of "
                    f"{count}; hold it still and take the reference again"
                )
        average, noise = mean.mean, None
        if not np.isfinite(average).any():
            raise DataError(
                "expected readings of the untouched sensor, but every channel is bad; check the "
                "board and its cable"
            )
        if count > 1:
            departures = relative_difference(values, average)
            noise = math.sqrt(2.0 * float(np.nanmean(departures**2)) * count / (count - 1))
        time_text = datetime.now(UTC).isoformat(timespec="seconds")
        return cls(average, protocol, frequency, zero, count, noise, time_text, board, source)

    def magnitudes(self, usual: NDArray[np.float64]) -> NDArray[np.float64]:
        """Magnitudes (measurements,) [ohm]; `usual` ones, scaled, where a channel was bad."""
        require_axes("usual", usual, len(self.protocol), more=False)
        finite = np.isfinite(self.impedance)
        scale = np.median(np.abs(self.impedance[finite]) / usual[finite])
        return np.where(finite, np.abs(self.impedance), scale * usual)

    def frame(self, time: float = 0.0) -> Frame:
        """The reference as a frame at a time [s]; bad channels are NaN."""
        return Frame(self.impedance, self.protocol, time, frequency=self.frequency)

    def write(self, path: str | Path) -> Path:
        """Write the file, whole or not at all; returns its path.

        Raises ConfigurationError where it cannot be written.
        """
        path = Path(path)
        document = {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "protocol": asdict(self.protocol),
            **{name: getattr(self, name) for name in self.__slots__[2:]},
            **{
                name: [value if math.isfinite(value) else None for value in part.tolist()]
                for name, part in (
                    ("real", self.impedance.real),
                    ("imaginary", self.impedance.imag),
                )
            },
        }
        with atomic_file(path) as temporary:
            temporary.write_text(json.dumps(document, allow_nan=False) + "\n", encoding="utf-8")
        return path

    @classmethod
    def read(cls, path: str | Path) -> "StoredReference":
        """Reference from a file.

        Raises DataError for a file that is missing, damaged, no reference, or newer than this
        eitskin.
        """
        path = Path(path)
        try:
            data = parse_json(read_bytes(path, MAX_FILE))
            if not isinstance(data, dict) or data.pop("format", None) != FORMAT:
                raise DataError(f"{path} is no reference; make one with eitskin tare")
            if (version := data.pop("format_version", None)) != FORMAT_VERSION:
                raise DataError(
                    f"{path} has format version {version}, this eitskin reads {FORMAT_VERSION}; "
                    "install a newer eitskin, or make the reference again with eitskin tare"
                )
            return build(_reference, data, Location(str(path)))
        except DataError:
            raise
        except (ConfigurationError, ValueError) as error:
            raise DataError(
                f"{path} is no whole reference: {error}; make it again with eitskin tare"
            ) from error


def _reference(
    protocol: Protocol,
    frequency: float,
    zero: Literal["flat", "as mounted"],
    frames: int,
    noise: float | None,
    taken: str,
    board: str,
    source: str,
    real: tuple[float | None, ...],
    imaginary: tuple[float | None, ...],
) -> StoredReference:
    """The reference of a file, null where a channel was bad; raises ValueError for others."""
    if not len(real) == len(imaginary) == len(protocol):
        raise ValueError(
            f"expected {len(protocol)} real and imaginary values, got {len(real)} and "
            f"{len(imaginary)}"
        )
    parts = np.array([real, imaginary], dtype=float)  # None becomes NaN
    impedance = parts[0] + 1j * parts[1]
    if not np.isfinite(impedance).any() or (impedance == 0).any():
        raise ValueError("expected impedances other than 0 ohm, and a good channel at least")
    if frames < 1 or frequency <= 0 or not (noise is None or noise >= 0):
        raise ValueError("expected a positive number of frames and a frequency above 0 Hz")
    datetime.fromisoformat(taken)
    return StoredReference(
        impedance, protocol, frequency, Zero(zero), frames, noise, taken, board, source
    )
