"""Replay of a recording or training set as a board."""

import math
import time
from collections.abc import Callable, Iterator

import numpy as np

from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.folder import open_dataset
from eitskin.errors import ConfigurationError, DataError
from eitskin.frame import Frame
from eitskin.hardware.boards.board import Board
from eitskin.hardware.protocol.messages import Info
from eitskin.protocol import Protocol

SPEEDS = ("real", "max")
BEGINNING = 2.0  # s of a session whose frames are never skipped: they are its reference


class ReplayBoard(Board):
    """Board that replays a dataset: its frames in order, with their recorded status.

    Frames missing by their numbers were lost during the recording and are counted.

    Attributes:
        info: settings of the recorded board; NaN where the recording has none.
        pause: minimum time between two frames [s], 0 at first; frames between them are skipped,
            except at the beginning of a session.

    Example:
        >>> from eitskin.hardware import ReplayBoard
        >>> board = ReplayBoard("monday")  # doctest: +SKIP
    """

    info: Info

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
            path: folder of a dataset, or one of its shards.
            uri: name of the board in messages.
            speed: "max", as fast as frames are taken, or "real", by their recorded times.
            clock: time for "real" [s].
            wait: sleeps for a number of seconds, for "real".

        Raises:
            ConfigurationError: for another speed, or no path.
            DataError: for no dataset, or a dataset without its measurement pattern.
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
        self.pause = 0.0

    def frames(self, newest: bool = False) -> Iterator[Frame]:  # noqa: ARG002
        """Recorded frames from the first; `newest` has no effect, since no frame waits."""
        offset = self._clock()
        since = begun = 0.0  # time of the session, and since the last frame that was not skipped
        for index in range(len(self._data)):
            pause = self._pause(index)
            if self._real:
                offset += pause
                self._wait(max(0.0, offset - self._clock()))
            self._frames += 1
            self._lost += self._gap(index)
            begun = begun + pause if self._follows(index) else 0.0
            since += pause
            if since < self.pause and begun > BEGINNING:
                self._skipped += 1
                continue
            since = 0.0
            yield self._data.frame(index)

    @property
    def duration(self) -> float:
        """Time that the recording took, without pauses between its sessions [s]."""
        return sum(self._pause(index) for index in range(len(self._data)))

    def calibrate(self) -> None:
        raise ConfigurationError("a recording cannot be calibrated; calibrate the board itself")

    def reconnect(self) -> None:
        """Do nothing: a recording needs no connection."""

    def close(self) -> None:
        """Do nothing: the recording is in memory."""

    def _gap(self, index: int) -> int:
        """Number of frames missing before frame `index`; 0 where a session begins."""
        number = self._data.number
        if not self._follows(index):
            return 0
        gap = (int(number[index]) - int(number[index - 1]) - 1) % 2**32
        return gap if gap < 2**31 else 0

    def _follows(self, index: int) -> bool:
        """Whether frame `index` is of the same session as the one before it."""
        episode = self._data.episode
        return index > 0 and bool(episode[index] == episode[index - 1])

    def _pause(self, index: int) -> float:
        """Time since the frame before [s]; one period where an episode begins."""
        time_ = self._data.time
        if index == 0:
            return 0.0
        pause = float(time_[index] - time_[index - 1])
        return pause if self._follows(index) and 0.0 <= pause < math.inf else self.info.period


def _info(data: Dataset, protocol: Protocol) -> Info:
    steps = np.diff(data.time)
    forward = steps[np.isfinite(steps) & (steps > 0)]
    return Info.from_protocol(
        protocol,
        firmware=data.source,
        frequency=data.frequency,
        period=float(np.median(forward)) if len(forward) else 0.0,
    )
