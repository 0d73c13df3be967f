"""Fault of the virtual board: first frame, duration, and effects at the board's hooks."""

import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.hardware.protocol.messages import Info
from eitskin.protocol import Protocol


class Hook(Enum):
    """Points at which the board consults its faults; each comment names the value that passes."""

    NETWORK = auto()  # (electrodes, electrodes) [ohm]: impedance matrix of the sensor
    IMPEDANCE = auto()  # (measurements,) complex64 [ohm], of one frame
    STATUS = auto()  # (measurements,) bits of `Status`, of one frame
    PACKET = auto()  # bytes of one frame; the effect may raise Unplugged
    DELAY = auto()  # float: extra time until the next frame [s]
    REPLY = auto()  # bytes that answer one request
    LINE = auto()  # bytes of anything that the board sends
    INFO = auto()  # Info: the identity that the board gives
    REBOOTS = auto()  # bool: the board starts again instead of measuring the frame
    FIRST_NUMBER = auto()  # int: number of the first frame after a start
    STREAMS = auto()  # bool: frames are sent unasked after a start
    STAYS_OUT = auto()  # bool: the cable, once pulled, is not put back
    PORT_HELD = auto()  # bool: another program has the port open


AT_START = (Hook.FIRST_NUMBER, Hook.STREAMS)
"""Consulted at every start of the board, also before the first frame of a fault."""

Effect = Callable[[Any, "Fault"], Any]
"""Function from the value at a hook, and the fault, to the value that the board uses."""


class UnpluggedError(Exception):
    """Signal that the cable has been pulled.

    Attributes:
        sent: bytes that still came through.
        back_after: time until cable and board are back [s]; None where the cable stays out.
    """

    def __init__(self, sent: bytes = b"", back_after: float | None = None) -> None:
        """Pull the cable after the bytes `sent`."""
        super().__init__()
        self.sent, self.back_after = sent, back_after


@dataclass(frozen=True, slots=True)
class FaultKind:
    """Kind of fault: one row of the table of faults.

    Attributes:
        meaning: one sentence, for `eitskin virtual-board --list-faults`.
        effects: effect at each hook, from the fault's first frame on.
        unit: unit of the index; empty where the index has no effect.
        default: amount that index 0 stands for.
        frame: the first frame, or request, where none is given.
        stays: frames until the fault is removed, by its amount; None until it is cleared.
    """

    meaning: str
    effects: Mapping[Hook, Effect]
    unit: str = ""
    default: int = 0
    frame: int = 5
    stays: Callable[[int], int] | None = None


@dataclass(slots=True)
class Fault:
    """Fault of one virtual board.

    Frames are counted since the board was made, across restarts; faults of replies count requests.

    Attributes:
        name: name, as in "name@frame:index".
        kind: row of the table.
        frame: the first frame with the fault.
        index: number of the bit, byte, channel or electrode, or a count; see `FaultKind.unit`.
        rng: generator seeded by the index.
        memory: values that an effect keeps for later frames.
        since: frames since the first, at the hook that is being consulted.
        info, protocol: identity and measurement table of the faultless board.
    """

    name: str
    kind: FaultKind
    frame: int
    index: int = 0
    rng: random.Random = field(init=False)
    memory: dict[str, Any] = field(init=False, default_factory=dict)
    since: int = field(init=False, default=0)
    info: Info = field(init=False)
    protocol: Protocol = field(init=False)

    def __post_init__(self) -> None:
        """Seed the generator."""
        self.rng = random.Random(self.index)  # noqa: S311

    def __str__(self) -> str:
        """Name and index, as "name:index"."""
        return f"{self.name}:{self.index}" if self.index else self.name

    @property
    def amount(self) -> int:
        """The index; the kind's default for 0."""
        return self.index or self.kind.default

    @property
    def channel(self) -> int:
        """Number of the measurement `index`, modulo their count."""
        return self.index % len(self.protocol)

    @property
    def electrode(self) -> int:
        """Number of the electrode `index`, modulo their count."""
        return self.index % self.protocol.n_electrodes

    @property
    def pairs(self) -> NDArray[np.bool_]:
        """Measurements that the electrode takes part in, (n,)."""
        involved: NDArray[np.bool_] = (np.array(self.protocol.table) == self.electrode).any(axis=1)
        return involved

    def change(self, hook: Hook, value: Any, now: int, info: Info, protocol: Protocol) -> Any:
        """Value after this fault at `hook` in frame `now`; unchanged before the first frame."""
        effect = self.kind.effects.get(hook)
        if effect is None or (now < self.frame and hook not in AT_START):
            return value
        self.since, self.info, self.protocol = now - self.frame, info, protocol
        with np.errstate(invalid="ignore"):  # values may be infinite by another fault
            return effect(value, self)

    def is_over(self, now: int) -> bool:
        """Whether the fault is to be removed before frame `now`."""
        return self.kind.stays is not None and now - self.frame >= self.kind.stays(self.amount)
