"""What is written beside a live session: a disk that fails ends the recording, not the session."""

from abc import ABC, abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING

from eitskin.errors import PartialError

if TYPE_CHECKING:
    from eitskin.datasets.store.writer import ShardWriter
    from eitskin.hardware.export.mcap import McapWriter
    from eitskin.hardware.live import Reading


class Recording(ABC):
    """What is written of a session.

    Attributes:
        problem: why no more is written; empty while all is.
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
        """Write what is left, if that can be."""
        try:
            self._finish()
        except PartialError as error:
            self._fail(error)

    @property
    @abstractmethod
    def loss(self) -> str:
        """What is not there in the end, and why; empty where all is."""

    @abstractmethod
    def _write(self, reading: "Reading") -> None:
        """Raises PartialError where it cannot be written."""

    @abstractmethod
    def _finish(self) -> None:
        """Raises PartialError where that fails."""

    def _fail(self, error: PartialError) -> None:
        # What follows is what to do in the end, and the session goes on.
        self.problem = self.problem or str(error).partition(";")[0]


class FrameRecording(Recording):
    """Frames, as a dataset that can be replayed."""

    def __init__(self, writer: "ShardWriter", folder: Path) -> None:
        """Write by `writer`, which is closed with this, into `folder`."""
        super().__init__()
        self._writer, self._folder, self._given = writer, folder, 0

    @property
    def missing(self) -> int:
        """Frames that can not be read back; those not yet written are among them."""
        return self._given - self._writer.readable

    @property
    def loss(self) -> str:
        """How many frames are missing."""
        if not self.missing:
            return ""
        return (
            f"{self.missing} frames are not in {self._folder}: {self.problem}; those before are "
            "there and can be replayed"
        )

    def append(self, reading: "Reading") -> None:
        """Count and write the frame."""
        self._given += 1
        super().append(reading)

    def _write(self, reading: "Reading") -> None:
        self._writer.append(reading.frame)

    def _finish(self) -> None:
        self._writer.close()


class MessageRecording(Recording):
    """Frames and estimates, as messages in an MCAP file."""

    def __init__(self, writer: "McapWriter") -> None:
        """Write by `writer`, which is closed with this."""
        super().__init__()
        self._writer = writer
        self._said = ""

    @property
    def loss(self) -> str:
        """Why there is no file, and where that lies which was written before."""
        return self._said

    def _write(self, reading: "Reading") -> None:
        self._writer.write(reading)

    def _finish(self) -> None:
        self._writer.close()

    def _fail(self, error: PartialError) -> None:
        super()._fail(error)
        self._said = self._said or str(error)
