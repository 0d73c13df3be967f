"""Frame of measurements, the common output of simulators and boards."""

import math
from dataclasses import dataclass, field
from enum import IntFlag

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import FrameError
from eitskin.protocol import Protocol


class Status(IntFlag):
    """Status bits of one measurement; 0 is good.

    Example:
        >>> from eitskin.simulator import Status
        >>> Status(9)
        <Status.CLIPPED|OPEN: 9>
    """

    CLIPPED = 1
    FIFO_OVERFLOW = 2
    DFT_TIMEOUT = 4
    OPEN = 8
    LOW_CURRENT = 16
    UNCALIBRATED = 32
    NOT_FINITE = 64  # set by the host, where a board sends NaN or infinity


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """All measurements of a protocol, each taken once, by a simulated or real sensor.

    Attributes:
        impedance: complex, one value per measurement of `protocol`, in its order [ohm].
        protocol: drive and sense electrodes of each value.
        time: since the session began [s].
        number: number of the frame in its session; a gap means lost frames.
        session: changes when a board has restarted; references of another session are not valid.
        frequency: frequency of the excitation [Hz].
        status: `Status` bits, (measurements,) uint8; zeros where nothing is wrong.
        duration: time that its measurements took [s]; NaN where unknown.

    Example:
        >>> import numpy as np
        >>> from eitskin import Frame, Protocol
        >>> frame = Frame(np.full(28, 600.0), Protocol.pairwise(8), time=0.3, number=1)
        >>> frame.impedance.shape
        (28,)
    """

    impedance: NDArray[np.complex128]
    protocol: Protocol
    time: float = 0.0
    number: int = 0
    session: int = 0
    frequency: float = 40e3
    status: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    duration: float = math.nan

    def __post_init__(self) -> None:
        """Check the shapes; an omitted status is all good."""
        impedance = np.array(self.impedance, dtype=np.complex128)
        status = np.array(self.status, dtype=np.uint8)
        if status.size == 0:
            status = np.zeros(len(self.protocol), np.uint8)
        for name, value in (("impedance", impedance), ("status", status)):
            if value.shape != (len(self.protocol),):
                raise FrameError(
                    f"{name} must have one value for each of the protocol's "
                    f"{len(self.protocol)} measurements, got shape {value.shape}"
                )
            value.flags.writeable = False
            object.__setattr__(self, name, value)
