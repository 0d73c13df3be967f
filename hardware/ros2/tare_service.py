"""Service that takes the sensor, as it is now, for the zero of all estimates."""

from collections.abc import Callable, Sequence
from typing import Any

from eitskin.errors import EitskinError
from eitskin.frame import Frame
from eitskin.hardware.ros2.participant import RosParticipant, write_at_once

TYPE = "std_srvs/srv/Trigger"
MOST_AT_ONCE = 100  # requests that are taken together

Tare = Callable[[Sequence[Frame]], str]
"""Makes frames of the untouched sensor the zero; returns how, and raises EitskinError if not."""


class TareService:
    """Service std_srvs/srv/Trigger that is answered in the live loop, frame by frame.

    A request is answered after so many frames that came since; requests meanwhile get the same
    answer. Frames of a session that ended do not count.
    """

    def __init__(self, participant: RosParticipant, name: str, tare: Tare, frames: int) -> None:
        """Offer the service under a name; it uses the mean of so many frames."""
        self._tare, self._count = tare, frames
        self._requests, self._replies = participant.service(name, TYPE)
        self._waiting: list[Any] = []
        self._frames: list[Frame] = []

    def follow(self, frame: Frame) -> None:
        """Use one frame; answer requests whose frames are complete."""
        self._waiting += self._new()
        if not self._waiting:
            return
        if self._frames and self._frames[0].session != frame.session:
            self._frames = []
        self._frames.append(frame)
        if len(self._frames) < self._count:
            return
        frames, self._frames = self._frames, []
        try:
            self._answer(True, self._tare(frames))
        except EitskinError as error:
            self._answer(False, str(error))

    def close(self) -> None:
        """Answer requests that came too late."""
        self._waiting += self._new()
        self._answer(False, "the session ended before enough frames came; begin it anew")
        self._requests = self._replies = None

    def _new(self) -> list[Any]:
        """Requests since the last frame; that a client has gone is no request."""
        taken = self._requests.take(MOST_AT_ONCE)
        return [request for request in taken if request.sample_info.valid_data]

    def _answer(self, success: bool, message: str) -> None:
        for request in self._waiting:
            reply = self._replies.data_type(
                client=request.client,
                sequence_number=request.sequence_number,
                success=success,
                message=message,
            )
            write_at_once(self._replies, reply)
        self._waiting = []
