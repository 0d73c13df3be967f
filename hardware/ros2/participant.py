"""Participant of DDS that ROS 2 takes for a process with one node."""

import os
from typing import Any

from eitskin.closeable import Closeable
from eitskin.errors import ConfigurationError
from eitskin.extras import require
from eitskin.hardware.ros2 import node_message
from eitskin.hardware.ros2.dds_types import DdsTypes
from eitskin.hardware.ros2.names import dds_service, dds_topic, require_domain

DEPTH = 10  # messages that wait for a slow subscriber, as in ROS 2's default profile
LINGER = (
    "<CycloneDDS><Domain><Internal><WriterLingerDuration>50 ms</WriterLingerDuration></Internal>"
    "</Domain></CycloneDDS>"
)
"""Configuration by which each writer waits no longer, when it is closed, for subscribers that have
vanished (a second otherwise)."""

_SHARED: list[Any] = []


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
            namespace: of the node, without a leading slash.
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
            self._writer(dds_topic(topic), self._types.of(kind), data, latched), kind, self._types
        )

    def service(self, name: str, kind: str) -> tuple[Any, Any]:
        """Reader of requests and writer of replies of a service, such as std_srvs/srv/Trigger."""
        from cyclonedds.sub import DataReader

        # A client takes a service for available once it sees both ends with one identifier.
        data = f"serviceid={'.'.join(f'{byte:x}' for byte in self._participant.guid.bytes)};"
        requests, replies = dds_service(name)
        topic = self._topic(requests, self._types.of_service(f"{kind}_Request"))
        reader = DataReader(self._participant, topic, qos=_profile(data))
        self._readers.append(reader)
        return reader, self._writer(replies, self._types.of_service(f"{kind}_Response"), data)

    def announce(self) -> None:
        """Tell the graph of ROS 2 the node with the readers and writers made so far."""
        definitions = node_message.NodeDefinitions.of_distribution()
        data = definitions.message(
            self._namespace, self._node, self._participant, self._readers, self._writers
        )
        types = DdsTypes(definitions.store)
        writer = self._writer(node_message.TOPIC, types.of(node_message.TYPE), "", latched=True)
        TopicWriter(writer, node_message.TYPE, types).write(data)

    def close(self) -> None:
        # An entity of DDS is deleted with the last reference to it.
        self._readers, self._writers, self._participant = [], [], None
        domain, self._domain = self._domain, None
        if domain is not None and domain.get_participants():
            _SHARED.append(domain)  # deleting it would delete them

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
        return write_at_once(self._writer, self._types.serialised(self._kind, data))


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
