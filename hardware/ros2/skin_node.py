"""ROS 2 node of a live sensor, in a participant of DDS that ROS 2 takes for a process with it."""

import os
import re
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from eitskin.closeable import Closeable
from eitskin.errors import ConfigurationError, EitskinError
from eitskin.extras import require, require_all
from eitskin.files import quote_value
from eitskin.frame import Frame
from eitskin.hardware.live import Reading
from eitskin.hardware.ros2.messages import NAME, RosMessages, build_message

NODE = "skin"  # name of the node, under the name of the skin
TARE_FRAMES = 32
TYPE = "std_srvs/srv/Trigger"
MAX_REQUESTS = 100  # requests that are taken together

Tare = Callable[[Sequence[Frame]], str]
"""Makes frames of the untouched sensor the zero; returns how, and raises EitskinError if not."""

DISCOVERY_TOPIC = "ros_discovery_info"
DISCOVERY_TYPE = "rmw_dds_common/msg/ParticipantEntitiesInfo"
OLD = ("foxy", "galactic", "humble")
"""Distributions whose identifiers have 24 bytes; later ones have 16. The message has one name in
both, so that a domain can hold only one kind."""
MAX_DOMAIN = 232  # ports of UDP above 65535 would follow
MAX_NAME = 160  # characters of a namespace; names of topics in DDS have at most 255
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")


def dds_service(service: str) -> tuple[str, str]:
    """Names of the topics of requests and of replies of a service."""
    return f"rq{service}Request", f"rr{service}Reply"


def dds_type_name(kind: str) -> str:
    """Name of a type, such as std_msgs::msg::dds_::String_ for std_msgs/msg/String."""
    package, folder, name = kind.split("/")
    return f"{package}::{folder}::dds_::{name}_"


def require_name(name: str) -> str:
    """Check the name of a skin, which its topics begin with, and return it.

    Raises ConfigurationError for a name that ROS 2 does not allow.
    """
    bare = name.strip("/")
    if not _NAME.fullmatch(bare) or "__" in bare or len(bare) > MAX_NAME:
        raise ConfigurationError(
            "expected a ROS 2 namespace of letters, digits and single underscores, in parts that "
            f"begin with no digit, of at most {MAX_NAME} characters, such as left_hand/skin, got "
            f"{quote_value(name)}"
        )
    return bare


def require_domain(domain: int) -> int:
    """Check the number of a DDS domain and return it.

    Raises ConfigurationError outside 0 to 232.
    """
    if not 0 <= domain <= MAX_DOMAIN:
        raise ConfigurationError(
            f"expected a DDS domain of 0 to {MAX_DOMAIN}, got {domain}; take the robot's "
            "ROS_DOMAIN_ID"
        )
    return domain


SCALARS = {"bool": bool, "string": str}
CHARACTER = "uint8"  # what ROS 2 makes of its type char

HEADER = {"client": "uint64", "sequence_number": "int64"}
"""What rmw_cyclonedds_cpp puts before requests and replies, so that each finds its way back."""

SERVICE_TYPES = {
    "std_srvs/srv/Trigger_Request": {"structure_needs_at_least_one_member": "uint8"},
    "std_srvs/srv/Trigger_Response": {"success": "bool", "message": "string"},
}
"""Halves of services; an empty message has one octet in ROS 2."""


class DdsTypes:
    """Types of Cyclone DDS by the name of the ROS 2 type; each is made once."""

    def __init__(self, store: Any) -> None:
        """Use the definitions in `store`, a type store of rosbags."""
        self._store = store
        self._made: dict[str, Any] = {}

    def message_class(self, kind: str) -> Any:
        """Class of samples of a message type, such as sensor_msgs/msg/Image."""
        if kind not in self._made:
            _, fields = self._store.fielddefs[kind]
            self._made[kind] = _struct(kind, {name: self._field(each) for name, each in fields})
        return self._made[kind]

    def service_class(self, kind: str) -> Any:
        """Class of samples of one of `SERVICE_TYPES`, with the header of rmw_cyclonedds_cpp."""
        if kind not in self._made:
            fields = HEADER | SERVICE_TYPES[kind]
            self._made[kind] = _struct(kind, {name: _scalar(each) for name, each in fields.items()})
        return self._made[kind]

    def parse_sample(self, kind: str, data: bytes) -> Any:
        """Sample of a message type that is written as `data`, its CDR form."""
        sample = self.message_class(kind).__new__(self.message_class(kind))
        sample.serialize = lambda **_: data
        return sample

    def _field(self, description: Any) -> Any:
        """Type of a field from its description by rosbags."""
        from cyclonedds.idl import types
        from rosbags.interfaces import Nodetype

        node, inner = description
        if node == Nodetype.NAME:
            return self.message_class(inner)
        if node == Nodetype.BASE:
            name, longest = inner
            return types.bounded_str[longest] if longest else _scalar(name)
        element, count = self._field(inner[0]), inner[1]
        if node == Nodetype.ARRAY:
            return types.array[element, count]
        return types.sequence[element, count] if count else types.sequence[element]


def _struct(kind: str, fields: dict[str, Any]) -> Any:
    from cyclonedds.idl import make_idl_struct

    return make_idl_struct(kind.replace("/", "__"), dds_type_name(kind), fields)


def _scalar(name: str) -> Any:
    """Type of a number, text or truth value by its name in ROS 2."""
    from cyclonedds.idl import types

    if name == "char":
        name = CHARACTER
    return SCALARS[name] if name in SCALARS else getattr(types, name)


DEPTH = 10  # messages that wait for a slow subscriber, as in ROS 2's default profile
LINGER = (
    "<CycloneDDS><Domain><Internal><WriterLingerDuration>50 ms</WriterLingerDuration></Internal>"
    "</Domain></CycloneDDS>"
)
"""Configuration by which each writer waits no longer, when it is closed, for subscribers that have
vanished (a second otherwise)."""

_SHARED_PARTICIPANTS: list[Any] = []


class RosParticipant(Closeable):
    """Writers and readers of one ROS 2 node, which `ros2 node list` shows once it is announced.

    Writers are reliable, as in ROS 2's default profile, so that subscribers of any profile hear
    them. They never wait: of messages for a subscriber that does not keep up the oldest is dropped,
    and one that finds no room at all is refused.
    """

    def __init__(self, domain: int, namespace: str, node: str, store: Any) -> None:
        """Join a domain.

        Args:
            domain: number of the DDS domain, 0 to 232.
            namespace: namespace of the node, without a leading slash.
            node: name of the node.
            store: definitions of messages, a type store of rosbags.

        Raises:
            ImportError: naming the extra, where cyclonedds is missing.
            ConfigurationError: for a domain that cannot be joined.
        """
        require("cyclonedds", "ros2")
        self._store, self._types = store, DdsTypes(store)
        self._namespace, self._node = namespace, node
        self._domain, self._participant = _join(require_domain(domain))
        self._readers: list[Any] = []
        self._writers: list[Any] = []

    def topic(self, topic: str, kind: str, latched: bool = False) -> "TopicWriter":
        """Writer of messages of a type to a topic.

        A latched one also gives its last message to subscribers that come later.
        """
        data = f"typehash={self._store.hash_rihs01(kind)};"
        return TopicWriter(
            self._writer(f"rt{topic}", self._types.message_class(kind), data, latched),
            kind,
            self._types,
        )

    def service(self, name: str, kind: str) -> tuple[Any, Any]:
        """Reader of requests and writer of replies of a service, such as std_srvs/srv/Trigger."""
        from cyclonedds.sub import DataReader

        # A client takes a service for available once it sees both ends with one identifier.
        data = f"serviceid={'.'.join(f'{byte:x}' for byte in self._participant.guid.bytes)};"
        requests, replies = dds_service(name)
        topic = self._topic(requests, self._types.service_class(f"{kind}_Request"))
        reader = DataReader(self._participant, topic, qos=_profile(data))
        self._readers.append(reader)
        return reader, self._writer(replies, self._types.service_class(f"{kind}_Response"), data)

    def announce(self) -> None:
        """Announce to the graph of ROS 2 the node with the readers and writers made so far."""
        from rosbags.typesys import Stores, get_typestore

        old = os.environ.get("ROS_DISTRO") in OLD
        store = get_typestore(Stores.ROS2_HUMBLE if old else Stores.ROS2_JAZZY)

        def identifier(entity: Any) -> dict[str, Any]:
            guid = entity.guid.bytes.ljust(24 if old else 16, b"\0")
            return {"data": np.frombuffer(guid, np.uint8)}

        node = {
            "node_namespace": f"/{self._namespace}",
            "node_name": self._node,
            "reader_gid_seq": [identifier(reader) for reader in self._readers],
            "writer_gid_seq": [identifier(writer) for writer in self._writers],
        }
        fields = {"gid": identifier(self._participant), "node_entities_info_seq": [node]}
        data = store.serialize_cdr(build_message(store, DISCOVERY_TYPE, fields), DISCOVERY_TYPE)
        types = DdsTypes(store)
        writer = self._writer(
            DISCOVERY_TOPIC, types.message_class(DISCOVERY_TYPE), "", latched=True
        )
        TopicWriter(writer, DISCOVERY_TYPE, types).write(bytes(data))

    def close(self) -> None:
        # An entity of DDS is deleted with the last reference to it.
        self._readers, self._writers, self._participant = [], [], None
        domain, self._domain = self._domain, None
        if domain is not None and domain.get_participants():
            _SHARED_PARTICIPANTS.append(domain)  # deleting it would delete them

    def _topic(self, name: str, kind: Any) -> Any:
        from cyclonedds.topic import Topic

        return Topic(self._participant, name, kind)

    def _writer(self, topic: str, kind: Any, user_data: str, latched: bool = False) -> Any:
        from cyclonedds.pub import DataWriter

        writer = DataWriter(
            self._participant, self._topic(topic, kind), qos=_profile(user_data, latched)
        )
        self._writers.append(writer)
        return writer


class TopicWriter:
    """Writer of messages that are serialised already."""

    def __init__(self, writer: Any, kind: str, types: DdsTypes) -> None:
        """Write by a DDS writer of a message type."""
        self._writer, self._kind, self._types = writer, kind, types

    def write(self, data: bytes) -> bool:
        """Write a message in its CDR form, at once or not at all; whether it was taken."""
        return write_at_once(self._writer, self._types.parse_sample(self._kind, data))


def _join(domain: int) -> tuple[Any, Any]:
    """Domain, None where this process is in it already, and a participant."""
    from cyclonedds.core import DDSException
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.qos import Policy, Qos

    try:
        # ROS 2 takes only participants with an enclave, a name of its security, for its own.
        return _domain(domain), DomainParticipant(domain, qos=Qos(Policy.Userdata(b"enclave=/;")))
    except DDSException as error:
        raise ConfigurationError(
            f"expected to join DDS domain {domain}, got: {error}; check the network interfaces and "
            "CYCLONEDDS_URI"
        ) from error


def _domain(domain: int) -> Any:
    """Domain with `LINGER` and the user's configuration; None where this process has it."""
    from cyclonedds.core import DDSException
    from cyclonedds.domain import Domain

    try:
        return Domain(domain, ",".join(filter(None, (LINGER, os.environ.get("CYCLONEDDS_URI")))))
    except DDSException as error:
        if error.code != DDSException.DDS_RETCODE_PRECONDITION_NOT_MET:
            raise
        return None


def write_at_once(writer: Any, sample: Any) -> bool:
    """Write a sample without waiting for anybody; whether it was taken."""
    from cyclonedds.core import DDSException

    try:
        writer.write(sample)
    except DDSException as error:
        if error.code != DDSException.DDS_RETCODE_TIMEOUT:
            raise
        return False
    return True


def _profile(user_data: str, latched: bool = False) -> Any:
    """Quality of service: ROS 2's default profile, without blocking."""
    from cyclonedds.qos import Policy, Qos

    history = Policy.History.KeepLast(1 if latched else DEPTH)
    policies = [
        Policy.Reliability.Reliable(max_blocking_time=0),
        history,
        Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
        # ROS 2 reads the first version of CDR only.
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Userdata(user_data.encode()),
    ]
    if latched:  # what Cyclone DDS keeps for late subscribers
        policies.append(Policy.DurabilityService(0, history, -1, -1, -1))
    return Qos(*policies)


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
