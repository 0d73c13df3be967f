"""ROS 2 node of a live sensor."""

import time
from collections.abc import Callable, Sequence
from typing import Any

from eitskin.closeable import Closeable
from eitskin.errors import EitskinError
from eitskin.extras import require_all
from eitskin.frame import Frame
from eitskin.hardware.live import Reading
from eitskin.hardware.ros2.messages import NAME, RosMessages
from eitskin.hardware.ros2.participant import RosParticipant, require_name, write_at_once

NODE = "skin"  # name of the node, under the name of the skin
TARE_FRAMES = 32
TYPE = "std_srvs/srv/Trigger"
MAX_REQUESTS = 100  # requests that are taken together

Tare = Callable[[Sequence[Frame]], str]
"""Makes frames of the untouched sensor the zero; returns how, and raises EitskinError if not."""


class SkinNode(Closeable):
    """Node that publishes readings as the messages of `messages.TOPICS`.

    A stamp is the frame's arrival by this machine's clock. Publishing waits for no subscriber.

    Attributes:
        name: name of the skin.
        refused: number of messages that DDS had no room for.
    """

    def __init__(
        self,
        name: str = NAME,
        domain: int = 0,
        tare: Tare | None = None,
        tare_frames: int = TARE_FRAMES,
        now: Callable[[], int] = time.time_ns,
    ) -> None:
        """Join a DDS domain and announce the node.

        Args:
            name: namespace of the topics and name of their frame of coordinates.
            domain: number of the domain, ROS_DOMAIN_ID elsewhere.
            tare: function of the service `tare`; without it there is no service.
            tare_frames: number of frames for the service.
            now: clock [ns].

        Raises:
            ImportError: naming the extra, where cyclonedds or rosbags is missing.
            ConfigurationError: for an impossible name, or a domain that cannot be joined.
        """
        require_all(ros2="cyclonedds rosbags")
        self.name, self.refused, self._now = require_name(name), 0, now
        self._messages = RosMessages(self.name)
        self._participant = RosParticipant(domain, self.name, NODE, self._messages.store)
        about = self._messages.topic("sensor")
        self._topics = {
            topic: self._participant.topic(topic, kind, latched=topic == about)
            for topic, kind in self._messages.types.items()
        }
        self._service = None
        if tare is not None:
            name = f"/{self.name}/tare"
            self._service = TareService(self._participant, name, tare, tare_frames)
        self._participant.announce()
        self._session: int | None = None

    def publish(self, reading: Reading) -> None:
        """Publish one reading, and go on with what clients have asked for."""
        stamp = self._now() - round(1e9 * reading.latency)
        messages = self._messages.make_messages(reading, stamp)
        if reading.frame.session != self._session:
            self._session = reading.frame.session
            messages |= self._messages.sensor(reading.frame)
        for topic, message in messages.items():
            data = self._messages.serialise(topic, message)
            self.refused += not self._topics[topic].write(data)
        if self._service is not None:
            self._service.follow(reading.frame)

    def close(self) -> None:
        if self._service is not None:
            self._service.close()
        self._service, self._topics = None, {}
        self._participant.close()


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
        self._answer(False, "the session ended before enough frames came; begin it again")
        self._requests = self._replies = None

    def _new(self) -> list[Any]:
        """Requests since the last frame; that a client has gone is no request."""
        requests = self._requests.take(MAX_REQUESTS)
        return [request for request in requests if request.sample_info.valid_data]

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
