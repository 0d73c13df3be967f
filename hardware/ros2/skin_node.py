"""ROS 2 node of a live sensor."""

import time
from collections.abc import Callable

from eitskin.closeable import Closeable
from eitskin.extras import require_all
from eitskin.hardware.export.ros_messages import NAME, RosMessages
from eitskin.hardware.live import Reading
from eitskin.hardware.ros2.names import require_name
from eitskin.hardware.ros2.participant import RosParticipant
from eitskin.hardware.ros2.tare_service import Tare, TareService

NODE = "skin"  # name of the node, under the name of the skin
TARE_FRAMES = 32


class SkinNode(Closeable):
    """Node that publishes readings as the messages of `ros_messages.TOPICS`.

    A stamp is the time, by the clock of this machine, at which the frame came. Publishing never
    waits for a subscriber.

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
            tare: what the service `tare` does with frames; without it there is no service.
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
        said = self._messages.of(reading, stamp)
        if reading.frame.session != self._session:
            self._session = reading.frame.session
            said |= self._messages.sensor(reading.frame)
        for topic, message in said.items():
            data = self._messages.serialised(topic, message)
            self.refused += not self._topics[topic].write(data)
        if self._service is not None:
            self._service.follow(reading.frame)

    def close(self) -> None:
        if self._service is not None:
            self._service.close()
        self._service, self._topics = None, {}
        self._participant.close()
