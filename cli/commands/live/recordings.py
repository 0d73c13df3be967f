"""Recordings of a live session: a disk that fails ends the recording, not the session."""

from abc import ABC, abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING

from eitskin.errors import PartialError

if TYPE_CHECKING:
    from eitskin.datasets.store.writer import ShardWriter
    from eitskin.hardware.live import Reading
    from eitskin.hardware.ros2.mcap import McapWriter


class Recording(ABC):
    """Recording of a session's readings.

    Attributes:
        problem: reason why nothing more is written; empty while everything is.
    """

    def __init__(self) -> None:
        """Begin without a problem."""
        self.problem = ""

    def append(self, reading: "Reading") -> None:
        """Write the reading, unless that failed before."""
        if self.problem:
            return
        try:
            self._write(reading)
        except PartialError as error:
            self._fail(error)

    def close(self) -> None:
        """Write remaining data, where possible."""
        try:
            self._finish()
        except PartialError as error:
            self._fail(error)

    @property
    @abstractmethod
    def loss(self) -> str:
        """Missing data and the reason; empty where everything was written."""

    @abstractmethod
    def _write(self, reading: "Reading") -> None:
        """Raises PartialError where it cannot be written."""

    @abstractmethod
    def _finish(self) -> None:
        """Raises PartialError where that fails."""

    def _fail(self, error: PartialError) -> None:
        # The rest of the message is the remedy for the end; the session goes on.
        self.problem = self.problem or str(error).partition(";")[0]


class FrameRecording(Recording):
    """Recording of frames as a dataset that can be replayed.

    Attributes:
        folder: of the dataset.
        given: number of frames so far.
    """

    def __init__(self, writer: "ShardWriter", folder: Path) -> None:
        """Write into `folder` by `writer`, which `close` closes."""
        super().__init__()
        self._writer, self.folder, self.given = writer, folder, 0

    @property
    def missing(self) -> int:
        """Number of frames that cannot be read back, among them frames not yet written."""
        return self.given - self._writer.readable

    @property
    def loss(self) -> str:
        """How many frames are missing."""
        if not self.missing:
            return ""
        return (
            f"{self.missing} frames are not in {self.folder}: {self.problem}; those before are "
            "there and can be replayed"
        )

    def append(self, reading: "Reading") -> None:
        """Count and write the frame."""
        self.given += 1
        super().append(reading)

    def _write(self, reading: "Reading") -> None:
        self._writer.append(reading.frame)

    def _finish(self) -> None:
        self._writer.close()


class MessageRecording(Recording):
    """Recording of frames and estimates as messages in an MCAP file."""

    def __init__(self, writer: "McapWriter") -> None:
        """Write by `writer`, which `close` closes."""
        super().__init__()
        self._writer = writer
        self._said = ""

    @property
    def loss(self) -> str:
        """Reason why there is no file, and the path of the part that was written."""
        return self._said

    def _write(self, reading: "Reading") -> None:
        self._writer.write(reading)

    def _finish(self) -> None:
        self._writer.close()

    def _fail(self, error: PartialError) -> None:
        super()._fail(error)
        self._said = self._said or str(error)
