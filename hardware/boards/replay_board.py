"""Replay of a recording or training set as a board."""

import math
import time
from collections.abc import Callable, Iterator

import numpy as np

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
        time_, episode = self._data.time, self._data.episode
        steps = np.diff(time_)
        forward = steps[np.isfinite(steps) & (steps > 0)]
        self.info = Info.from_protocol(
            self.protocol,
            firmware=self._data.source,
            frequency=self._data.frequency,
            period=float(np.median(forward)) if len(forward) else 0.0,
        )
        # Whether each frame but the first is of the session of the one before; where not, a session
        # begins after one period, and no frames are missing.
        self._follows = episode[1:] == episode[:-1]
        sound = self._follows & (steps >= 0) & (steps < math.inf)
        self._pauses = np.where(sound, steps, self.info.period).tolist()
        gaps = np.mod(np.diff(self._data.number.astype(np.int64)) - 1, 2**32)
        self._gaps = np.where(self._follows & (gaps < 2**31), gaps, 0).tolist()
        self._real, self._clock, self._wait = speed == "real", clock, wait
        self.pause = 0.0

    def frames(self, newest: bool = False) -> Iterator[Frame]:  # noqa: ARG002
        """Recorded frames from the first; `newest` has no effect, since no frame waits."""
        offset = self._clock()
        since = begun = 0.0  # time of the session, and since the last frame that was not skipped
        for index in range(len(self._data)):
            pause, gap = (self._pauses[index - 1], self._gaps[index - 1]) if index else (0.0, 0)
            if self._real:
                offset += pause
                self._wait(max(0.0, offset - self._clock()))
            self._frames += 1
            self._lost += gap
            begun = begun + pause if index and self._follows[index - 1] else 0.0
            since += pause
            if since < self.pause and begun > BEGINNING:
                self._skipped += 1
                continue
            since = 0.0
            yield self._data.frame(index)

    @property
    def duration(self) -> float:
        """Time that the recording took, without pauses between its sessions [s]."""
        return float(sum(self._pauses))

    def calibrate(self) -> None:
        raise ConfigurationError("a recording cannot be calibrated; calibrate the board itself")

    def reconnect(self) -> None:
        """Do nothing: a recording needs no connection."""

    def close(self) -> None:
        """Do nothing: the recording is in memory."""
