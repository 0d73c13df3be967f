"""What can go wrong with the values in packets that are whole."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from eitskin.frame import Status
from eitskin.hardware.protocol.messages import FrameData, Info
from eitskin.hardware.virtual.fault import Fault
from eitskin.protocol import Protocol

STRAY_CAPACITANCE = 100e-12
"""What an open lead still sees [F]."""
SHORT = 2.0
"""Of a shorted pair, its leads [ohm]."""
CLIPPED_TO = 0.7
"""Of the impedance, what is left of a sine that is cut off."""
LOST_PER_FRAME = 0.05
"""What a failing contact adds to its resistance with each frame, of the pair's."""
GAIN_STEP = 1.02
WRONG_RTIA = 5.0
"""The next resistor of the AD5940, 1 kohm where 200 ohm are meant."""
DRIFT_PER_FRAME = 1e-4


class ValueFault(Fault):
    """From the frame on the values are others; nothing in the packet says so, unless told."""

    def measured(self, now: int, data: FrameData, protocol: Protocol, info: Info) -> FrameData:
        """The frame with other values."""
        if not self.lasts(now):
            return data
        data = dataclasses.replace(data, impedance=data.impedance.copy(), status=data.status.copy())
        self.change(now - self.frame, data, protocol, info)
        return data

    def change(self, since: int, data: FrameData, protocol: Protocol, info: Info) -> None:
        """Change the arrays of `data`, `since` frames after the first that is struck."""
        raise NotImplementedError

    def channel(self, data: FrameData) -> int:
        """The channel that is struck."""
        return self.index % len(data.impedance)

    def pairs(self, protocol: Protocol) -> NDArray[np.bool_]:
        """The measurements that the electrode which is struck takes part in."""
        electrode = self.index % protocol.n_electrodes
        taking: NDArray[np.bool_] = (np.array(protocol.table) == electrode).any(axis=1)
        return taking


class NanChannel(ValueFault):
    """Channel `index` is NaN."""

    def change(self, since: int, data: FrameData, protocol: Protocol, info: Info) -> None:  # noqa: ARG002
        """That channel."""
        data.impedance[self.channel(data)] = complex(np.nan, np.nan)


class InfChannel(ValueFault):
    """Channel `index` is infinite."""

    def change(self, since: int, data: FrameData, protocol: Protocol, info: Info) -> None:  # noqa: ARG002
        """That channel."""
        data.impedance[self.channel(data)] = complex(np.inf, 0.0)


class FrozenFrame(ValueFault):
    """All channels stay as they are, to the last bit."""

    _frozen: NDArray[np.complex64] | None = None

    def change(self, since: int, data: FrameData, protocol: Protocol, info: Info) -> None:  # noqa: ARG002
        """The values of the first frame."""
        if self._frozen is None:
            self._frozen = data.impedance.copy()
        data.impedance[:] = self._frozen


class StuckChannel(ValueFault):
    """Channel `index` stays as it is, to the last bit."""

    _stuck: complex | None = None

    def change(self, since: int, data: FrameData, protocol: Protocol, info: Info) -> None:  # noqa: ARG002
        """That channel."""
        if self._stuck is None:
            self._stuck = complex(data.impedance[self.channel(data)])
        data.impedance[self.channel(data)] = self._stuck


class Clipping(ValueFault):
    """Channel `index` is cut off by the converter, and marked so."""

    def change(self, since: int, data: FrameData, protocol: Protocol, info: Info) -> None:  # noqa: ARG002
        """That channel."""
        data.impedance[self.channel(data)] *= CLIPPED_TO
        data.status[self.channel(data)] |= np.uint8(Status.CLIPPED)


class OpenElectrode(ValueFault):
    """Electrode `index` has lost contact: its pairs see its stray capacitance, and are marked."""

    def change(self, since: int, data: FrameData, protocol: Protocol, info: Info) -> None:  # noqa: ARG002
        """All pairs of that electrode."""
        touched = self.pairs(protocol)
        data.impedance[touched] = 1.0 / (2j * np.pi * info.frequency * STRAY_CAPACITANCE)
        data.status[touched] |= np.uint8(Status.OPEN)


class ShortedPair(ValueFault):
    """The electrodes of channel `index` touch each other; they and all others see that."""

    def change(self, since: int, data: FrameData, protocol: Protocol, info: Info) -> None:  # noqa: ARG002
        """The channel is nearly nothing; both electrodes measure as the better of the two."""
        one, other = protocol.table[self.channel(data)][:2]
        value = {frozenset(row[:2]): i for i, row in enumerate(protocol.table)}
        for third in set(range(protocol.n_electrodes)) - {one, other}:
            both = [value.get(frozenset((end, third))) for end in (one, other)]
            rows = [row for row in both if row is not None]
            data.impedance[rows] = min(data.impedance[rows], key=abs, default=0.0)
        data.impedance[self.channel(data)] = SHORT


class SwappedElectrodes(ValueFault):
    """The wires of electrodes `index` and the next are swapped."""

    def change(self, since: int, data: FrameData, protocol: Protocol, info: Info) -> None:  # noqa: ARG002
        """Each row measures what the row with the swapped electrodes should."""
        n = protocol.n_electrodes
        swap = list(range(n))
        one, other = self.index % n, (self.index + 1) % n
        swap[one], swap[other] = other, one
        rows = {_unordered(row): i for i, row in enumerate(protocol.table)}
        source = [
            rows.get(_unordered([swap[e] for e in row]), i) for i, row in enumerate(protocol.table)
        ]
        data.impedance[:] = data.impedance[source]


class ContactLoss(ValueFault):
    """Electrode `index` loses contact slowly: its resistance grows frame by frame."""

    def change(self, since: int, data: FrameData, protocol: Protocol, info: Info) -> None:  # noqa: ARG002
        """All pairs of that electrode."""
        data.impedance[self.pairs(protocol)] *= 1.0 + LOST_PER_FRAME * since


class WrongRtia(ValueFault):
    """The board measures with another resistor than it reckons with."""

    def change(self, since: int, data: FrameData, protocol: Protocol, info: Info) -> None:  # noqa: ARG002
        """All channels by one factor."""
        data.impedance[:] /= WRONG_RTIA


class Phase360(ValueFault):
    """Every phase is off by 360 degrees, which changes no impedance but by rounding."""

    def change(self, since: int, data: FrameData, protocol: Protocol, info: Info) -> None:  # noqa: ARG002
        """All channels, through their phases in single precision."""
        phase = np.angle(data.impedance) + np.float32(2.0 * np.pi)
        data.impedance[:] = np.abs(data.impedance) * np.exp(1j * phase)


class GainStep(ValueFault):
    """All channels grow by two per cent at once."""

    def change(self, since: int, data: FrameData, protocol: Protocol, info: Info) -> None:  # noqa: ARG002
        """All channels by one factor."""
        data.impedance[:] *= GAIN_STEP


class DriftRamp(ValueFault):
    """All channels grow steadily."""

    def change(self, since: int, data: FrameData, protocol: Protocol, info: Info) -> None:  # noqa: ARG002
        """All channels by one factor, which grows."""
        data.impedance[:] *= 1.0 + DRIFT_PER_FRAME * since


def _unordered(row: tuple[int, ...] | list[int]) -> tuple[frozenset[int], frozenset[int]]:
    """A row without its directions."""
    return frozenset(row[:2]), frozenset(row[2:])


SENSOR_FAULTS: dict[str, type[Fault]] = {
    "nan_channel": NanChannel,
    "inf_channel": InfChannel,
    "frozen_frame": FrozenFrame,
    "stuck_channel": StuckChannel,
    "clipping": Clipping,
    "open_electrode": OpenElectrode,
    "shorted_pair": ShortedPair,
    "swapped_electrodes": SwappedElectrodes,
    "contact_loss": ContactLoss,
    "wrong_rtia": WrongRtia,
    "phase_360": Phase360,
    "gain_step": GainStep,
    "drift_ramp": DriftRamp,
}
