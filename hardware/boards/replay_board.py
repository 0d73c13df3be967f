"""A recording or a training set, replayed as if a board gave its frames."""

import math
import time
from collections.abc import Callable, Iterator

import numpy as np

from eitskin.closeable import Closeable
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.folder import open_dataset
from eitskin.errors import ConfigurationError, DataError
from eitskin.frame import Frame
from eitskin.hardware.boards.board import Counts
from eitskin.hardware.protocol.messages import Info, Table
from eitskin.protocol import Protocol

SPEEDS = ("real", "max")


class ReplayBoard(Closeable):
    """The frames of a dataset in their order, with the status they were recorded with.

    What its numbers leave out was lost when it was recorded, and is counted; see
    `eitskin.hardware.Board`.

    Attributes:
        uri: what it was opened as.
        info: what the recording says of its board; NaN where it does not.
        protocol: what was measured.
        stage: None; nobody can say what happened to a recorded sensor.
    """

    stage = None

    def __init__(
        self,
        path: str,
        uri: str = "",
        speed: str = "max",
        clock: Callable[[], float] = time.monotonic,
        wait: Callable[[float], None] = time.sleep,
    ) -> None:
        """Open a recording.

        Args:
            path: a dataset's folder, or one shard of it.
            uri: to name it in messages.
            speed: "max", as fast as frames are taken, or "real", by their recorded times.
            clock: seconds, for "real".
            wait: waits so many seconds, for "real".

        Raises:
            ConfigurationError: for another speed, or no path.
            DataError: where there is no dataset, or one that does not say what was measured.
        """
        self.uri = uri or f"replay:{path}"
        if not path:
            raise ConfigurationError("replay: needs a dataset's folder, such as replay:recordings")
        if speed not in SPEEDS:
            raise ConfigurationError(f"speed must be one of {', '.join(SPEEDS)}, got {speed!r}")
        self._data = open_dataset(path)
        if self._data.protocol is None:
            raise DataError(
                f"{path} does not say which electrodes its channels were measured at, so it has no "
                "frames to replay; import it again with --protocol"
            )
        self.protocol: Protocol = self._data.protocol
        self.info = _info(self._data, self.protocol)
        self._real, self._clock, self._wait = speed == "real", clock, wait
        self._frames = self._lost = 0

    @property
    def lost(self) -> int:
        """Frames lost so far, when they were recorded."""
        return self._lost

    @property
    def counts(self) -> Counts:
        """What has come through so far."""
        return Counts(frames=self._frames, lost=self._lost)

    def frames(self, newest: bool = False) -> Iterator[Frame]:  # noqa: ARG002
        """The recorded frames from the first; none overtakes another, so `newest` is all."""
        offset = self._clock()
        for index in range(len(self._data)):
            frame = self._data.frame(index)
            if self._real:
                offset += self._pause(index)
                self._wait(max(0.0, offset - self._clock()))
            self._frames += 1
            self._lost += self._gap(index)
            yield frame

    def calibrate(self) -> None:
        """Raises ConfigurationError."""
        raise ConfigurationError("a recording cannot be calibrated; calibrate the board it is of")

    def reconnect(self) -> None:
        """Nothing needs connecting."""

    def close(self) -> None:
        """Nothing needs closing, the recording is in memory."""

    def _gap(self, index: int) -> int:
        """Frames missing before this one; none where it begins a session."""
        number, episode = self._data.number, self._data.episode
        if index == 0 or episode[index] != episode[index - 1]:
            return 0
        gap = (int(number[index]) - int(number[index - 1]) - 1) % 2**32
        return gap if gap < 2**31 else 0

    def _pause(self, index: int) -> float:
        """Time from the frame before; one period where another episode begins [s]."""
        time_, episode = self._data.time, self._data.episode
        if index == 0:
            return 0.0
        same = episode[index] == episode[index - 1]
        pause = float(time_[index] - time_[index - 1])
        return pause if same and 0.0 <= pause < math.inf else self.info.period


def _info(data: Dataset, protocol: Protocol) -> Info:
    steps = np.diff(data.time)
    forward = steps[np.isfinite(steps) & (steps > 0)]
    return Info(
        firmware=data.source,
        uid=bytes(12),
        boot_count=0,
        n_electrodes=protocol.n_electrodes,
        n_measurements=len(protocol),
        table_crc32=Table(protocol.table).crc32,
        frequency=data.frequency,
        amplitude=math.nan,
        rtia=math.nan,
        rcal=math.nan,
        period=float(np.median(forward)) if len(forward) else 0.0,
    )
