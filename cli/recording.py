"""Frames written beside a live session: a disk that fails ends the recording, not the session."""

from typing import TYPE_CHECKING

from eitskin.geometry import PartialError

if TYPE_CHECKING:
    from eitskin.datasets import ShardWriter
    from eitskin.simulator import Frame


class Recording:
    """What is written of a session.

    Attributes:
        problem: why no more is written; empty while all is.
    """

    def __init__(self, writer: "ShardWriter") -> None:
        """Write by `writer`, which is closed with this."""
        self._writer, self._given = writer, 0
        self.problem = ""

    @property
    def missing(self) -> int:
        """Frames that can not be read back; those not yet written are among them."""
        return self._given - self._writer.readable

    def append(self, frame: "Frame") -> None:
        """Write the frame, unless that failed before."""
        self._given += 1
        if self.problem:
            return
        try:
            self._writer.append(frame)
        except PartialError as error:
            self._fail(error)

    def close(self) -> None:
        """Write what is left, if that can be."""
        try:
            self._writer.close()
        except PartialError as error:
            self._fail(error)

    def _fail(self, error: PartialError) -> None:
        # What follows is how to go on with a dataset that is made, and this one cannot be.
        self.problem = self.problem or str(error).partition(";")[0]
