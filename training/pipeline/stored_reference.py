"""Stored reference of one sensor: the zero of its estimates, in a small JSON file."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eitskin.bounds import LARGEST_READING, LEAST_READING
from eitskin.config import from_dict
from eitskin.errors import ConfigurationError, DataError
from eitskin.files import atomic_file, parse_json, quoted, read_bytes
from eitskin.frame import Frame
from eitskin.protocol import Protocol
from eitskin.training.method.observations import relative_difference
from eitskin.training.pipeline.references import RunningMean

FORMAT = "eitskin-reference"
FORMAT_VERSION = 1
LARGEST_FILE = 10_000_000  # bytes; a thousand measurements need 50,000


class Zero(StrEnum):
    """State of the sensor that estimates are relative to."""

    FIRST_FRAMES = "first frames"
    FLAT = "flat"
    MOUNTED = "as mounted"


@dataclass(frozen=True, slots=True, eq=False)
class StoredReference:
    """Mean of untouched frames of one sensor.

    Attributes:
        impedance: (measurements,) [ohm]; NaN where a channel was bad.
        protocol: of the measurements.
        frequency: of the excitation [Hz].
        zero: state of the sensor, `Zero.FLAT` or `Zero.MOUNTED`.
        frames: number of frames in the mean.
        noise: rms of the relative difference of two of the frames; None for a single one.
        taken: time of writing, ISO 8601 with time zone.
        board: unique number of the board in hexadecimal digits; empty where unknown.
        source: URI or path that the frames came from; empty where unknown.
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
    def of(
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
            protocol, frequency, zero, board, source: as the attributes.
            still: rms of the relative difference of two frames of a still sensor; twice that is
                motion.

        Raises:
            ConfigurationError: for no frames.
            DataError: for a sensor that moves, and for frames without a good channel.
        """
        if not len(impedance):
            raise ConfigurationError("expected frames of the untouched sensor, got none; give some")
        impedance = [_usable(each) for each in impedance]
        mean = RunningMean(still, longest=len(impedance))
        for number, values in enumerate(impedance, 1):
            if mean.add(values):
                raise DataError(
                    f"expected frames of a still sensor, but it moves in frame {number} of "
                    f"{len(impedance)}; hold it still and take the reference again"
                )
        average = np.asarray(mean.mean)
        if not np.isfinite(average).any():
            raise DataError(
                "expected readings of the untouched sensor, but every channel is bad; check the "
                "board and its cable"
            )
        count, noise = len(impedance), None
        if count > 1:
            departures = relative_difference(np.asarray(impedance), average)
            noise = math.sqrt(2.0 * float(np.nanmean(departures**2)) * count / (count - 1))
        taken = datetime.now(UTC).isoformat(timespec="seconds")
        return cls(average, protocol, frequency, zero, count, noise, taken, board, source)

    def magnitudes(self, usual: NDArray[np.float64]) -> NDArray[np.float64]:
        """Magnitudes (measurements,) [ohm]; `usual` ones, scaled, where a channel was bad."""
        known = np.isfinite(self.impedance)
        scale = np.median(np.abs(self.impedance[known]) / usual[known])
        return np.where(known, np.abs(self.impedance), scale * usual)

    def frame(self, time: float = 0.0) -> Frame:
        """The reference as a frame at a time [s]; bad channels are NaN."""
        return Frame(self.impedance, self.protocol, time, frequency=self.frequency)

    def write(self, path: str | Path) -> Path:
        """Write the file, whole or not at all; returns its path.

        Raises ConfigurationError where it cannot be written.
        """
        path = Path(path)
        document = {"format": FORMAT, "format_version": FORMAT_VERSION, **asdict(self._document())}
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
            data = parse_json(read_bytes(path, LARGEST_FILE))
            if not isinstance(data, dict) or data.pop("format", None) != FORMAT:
                raise DataError(f"{path} is no reference; make one with eitskin tare")
            if (found := data.pop("format_version", None)) != FORMAT_VERSION:
                raise DataError(
                    f"{path} has format version {found}, this eitskin reads {FORMAT_VERSION}; "
                    "install a newer eitskin, or make the reference again with eitskin tare"
                )
            return from_dict(_Document, data, str(path)).reference()
        except DataError:
            raise
        except (ConfigurationError, ValueError) as error:
            raise DataError(
                f"{path} is no whole reference: {error}; make it again with eitskin tare"
            ) from error

    def _document(self) -> "_Document":
        """Plain data for JSON."""
        return _Document(
            self.protocol,
            self.frequency,
            str(self.zero),
            self.frames,
            self.noise,
            self.taken,
            self.board,
            self.source,
            tuple(_plain(value) for value in self.impedance.real.tolist()),
            tuple(_plain(value) for value in self.impedance.imag.tolist()),
        )


@dataclass(frozen=True, slots=True)
class _Document:
    """Contents of the file, beside its format; null where a channel was bad."""

    protocol: Protocol
    frequency: float
    zero: str
    frames: int
    noise: float | None
    taken: str
    board: str
    source: str
    real: tuple[float | None, ...]
    imaginary: tuple[float | None, ...]

    def reference(self) -> StoredReference:
        """The reference; raises ValueError or ConfigurationError for impossible contents."""
        if not len(self.real) == len(self.imaginary) == len(self.protocol):
            raise ValueError(
                f"expected {len(self.protocol)} real and imaginary values, got {len(self.real)} "
                f"and {len(self.imaginary)}"
            )
        impedance = _complex(self.real, self.imaginary)
        if not np.isfinite(impedance).any() or (impedance == 0).any():
            raise ValueError("expected impedances other than 0 ohm, and a good channel at least")
        if self.frames < 1 or self.frequency <= 0 or not (self.noise is None or self.noise >= 0):
            raise ValueError("expected a positive number of frames and a frequency above 0 Hz")
        datetime.fromisoformat(self.taken)
        if self.zero not in (Zero.FLAT, Zero.MOUNTED):
            raise ValueError(
                f"expected zero '{Zero.FLAT}' or '{Zero.MOUNTED}', got {quoted(self.zero)}"
            )
        return StoredReference(
            impedance,
            self.protocol,
            self.frequency,
            Zero(self.zero),
            self.frames,
            self.noise,
            self.taken,
            self.board,
            self.source,
        )


def _complex(
    real: Sequence[float | None], imaginary: Sequence[float | None]
) -> NDArray[np.complex128]:
    parts = np.array([real, imaginary], dtype=float)  # None becomes NaN
    return np.asarray(parts[0] + 1j * parts[1], dtype=np.complex128)


def _usable(values: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Readings, NaN where they are none of any sensor."""
    size = np.abs(values)
    return np.where((size >= LEAST_READING) & (size <= LARGEST_READING), values, np.nan)


def _plain(value: float) -> float | None:
    """`value`, None where it is not finite."""
    return value if math.isfinite(value) else None
