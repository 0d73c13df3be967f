"""Second participant of ROS 2's topics: what it hears of a skin, as lines of JSON.

The classes are typed from the .msg and .srv files of ROS 2's common_interfaces, geometry2 and
rmw_dds_common; nothing of eitskin is imported. Run: ros2_listener.py DOMAIN NAME FRAMES.
"""

import json
import sys
import time
from dataclasses import asdict

from cyclonedds.builtin import (
    BuiltinDataReader,
    BuiltinTopicDcpsParticipant,
    BuiltinTopicDcpsPublication,
    BuiltinTopicDcpsSubscription,
)
from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

DEFINITIONS = """
builtin_interfaces/msg/Time: int32 sec, uint32 nanosec
std_msgs/msg/Header: Time stamp, string frame_id
std_msgs/msg/String: string data
diagnostic_msgs/msg/KeyValue: string key, string value
diagnostic_msgs/msg/DiagnosticStatus: byte level, string name, string message, string hardware_id,
    KeyValue[] values
diagnostic_msgs/msg/DiagnosticArray: Header header, DiagnosticStatus[] status
rmw_dds_common/msg/Gid: uint8[16] data
rmw_dds_common/msg/NodeEntitiesInfo: string<=256 node_namespace, string<=256 node_name,
    Gid[] reader_gid_seq, Gid[] writer_gid_seq
rmw_dds_common/msg/ParticipantEntitiesInfo: Gid gid, NodeEntitiesInfo[] node_entities_info_seq
std_srvs/srv/Trigger_Request: uint64 client, int64 sequence_number,
    uint8 structure_needs_at_least_one_member
std_srvs/srv/Trigger_Response: uint64 client, int64 sequence_number, bool success, string message
"""
"""Fields of the .msg and .srv files; those of services begin with rmw_cyclonedds_cpp's header."""


def field_type(text, known):
    """Type of a field from its text, such as uint8[16], string<=256 or Header."""
    name, _, count = text.rstrip("]").partition("[")
    name, _, longest = name.partition("<=")
    if longest:
        return types.bounded_str[int(longest)]
    single = {"string": str, "bool": bool}.get(name) or known.get(name) or getattr(types, name)
    if not text.endswith("]"):
        return single
    return types.array[single, int(count)] if count else types.sequence[single]


def message_types():
    """Classes of all definitions by their short name."""
    known = {}
    for line in DEFINITIONS.replace("\n    ", " ").strip().splitlines():
        kind, _, fields = line.partition(": ")
        package, folder, name = kind.split("/")
        made = {field: field_type(text, known) for text, field in map(str.split, fields.split(","))}
        known[name] = make_idl_struct(name, f"{package}::{folder}::dds_::{name}_", made)
    return known


TYPES = message_types()
TOPICS = {
    "rt/{}/sensor": "String",
    "rt/diagnostics": "DiagnosticArray",
    "ros_discovery_info": "ParticipantEntitiesInfo",
}
LATCHED = ("rt/{}/sensor", "ros_discovery_info")
HEADER = b"\x00\x01"  # little-endian CDR of the first version, which ROS 2 reads

RELIABLE = Policy.Reliability.Reliable(max_blocking_time=duration(seconds=1))
CDR = Policy.DataRepresentation(use_cdrv0_representation=True)
DEFAULT = Qos(RELIABLE, Policy.Durability.Volatile, Policy.History.KeepLast(10), CDR)
KEPT = Qos(RELIABLE, Policy.Durability.TransientLocal, Policy.History.KeepLast(1), CDR)


def say(**facts):
    sys.stdout.write(json.dumps(facts) + "\n")
    sys.stdout.flush()


def user_data(entity):
    policies = entity.qos
    return policies[Policy.Userdata].data.decode() if Policy.Userdata in policies else ""


class Listener:
    """Readers of all topics, and what they have heard."""

    def __init__(self, domain, name):
        self.participant = DomainParticipant(domain, qos=Qos(Policy.Userdata(b"enclave=/;")))
        self.waits = WaitSet(self.participant)
        self.heard = {kind: [] for kind in TOPICS.values()}
        self.readers = []
        for topic, kind in TOPICS.items():
            self.read(topic.format(name), kind, KEPT if topic in LATCHED else DEFAULT)

    def read(self, topic, kind, profile=DEFAULT):
        reader = DataReader(
            self.participant, Topic(self.participant, topic, TYPES[kind]), qos=profile
        )
        any_state = ViewState.Any | SampleState.Any | InstanceState.Any
        self.waits.attach(ReadCondition(reader, any_state))
        self.readers.append((reader, kind))
        self.heard.setdefault(kind, [])

    def wait(self):
        """Take what is there, after waiting for something."""
        self.waits.wait(timeout=duration(seconds=10))
        for reader, name in self.readers:
            for sample in reader.take(100):
                self.heard[name].append((time.time_ns(), sample))

    def endpoints(self, builtin):
        """Name, type, reliability, durability and user data of what the domain has to offer."""
        reader = BuiltinDataReader(self.participant, builtin)
        found = [
            {
                "topic": each.topic_name,
                "type": each.type_name,
                "reliable": each.qos[Policy.Reliability] != Policy.Reliability.BestEffort,
                "waits": getattr(each.qos[Policy.Reliability], "max_blocking_time", None),
                "latched": each.qos[Policy.Durability] == Policy.Durability.TransientLocal,
                "data": each.qos[Policy.Userdata].data.decode()
                if Policy.Userdata in each.qos
                else "",
                "key": each.key.hex,
                "cdr": each.qos[Policy.DataRepresentation].use_cdrv0_representation,
            }
            for each in reader.take(200)
            if each.participant_key != self.participant.guid
        ]
        return sorted(found, key=lambda each: each["topic"])

    def call(self, name, sequence_number):
        """Answer of the service."""
        request = TYPES["Trigger_Request"]
        topic = Topic(self.participant, f"rq/{name}/tareRequest", request)
        if not any(kind == "Trigger_Response" for _, kind in self.readers):
            self.read(f"rr/{name}/tareReply", "Trigger_Response")
            self.requests = DataWriter(self.participant, topic, qos=DEFAULT)
        self.requests.write(request(7, sequence_number, 0))
        while len(self.heard["Trigger_Response"]) < 1:
            self.wait()
        return asdict(self.heard["Trigger_Response"].pop()[1])


def summary(listener, frames):
    """What was heard, as plain data."""
    return {
        "stamps": [each.header.stamp.sec * 10**9 + each.header.stamp.nanosec for _, each in frames],
        "numbers": [
            next(pair.value for pair in each.status[0].values if pair.key == "number")
            for _, each in frames
        ],
        "status": [[s.level, s.name, s.message, s.hardware_id] for s in frames[-1][1].status],
        "sensor": [each.data for _, each in listener.heard["String"]],
        "nodes": [
            {
                "name": f"{node.node_namespace}/{node.node_name}",
                "readers": [bytes(gid.data).hex() for gid in node.reader_gid_seq],
                "writers": [bytes(gid.data).hex() for gid in node.writer_gid_seq],
            }
            for _, each in listener.heard["ParticipantEntitiesInfo"]
            for node in each.node_entities_info_seq
        ],
    }


def main(domain, name, count):
    """Say what was heard of so many frames, then two answers, then that session 9 was heard."""
    listener = Listener(int(domain), name)
    heard = listener.heard
    while len(heard["DiagnosticArray"]) < int(count) or not all(heard.values()):
        listener.wait()
    participants = BuiltinDataReader(listener.participant, BuiltinTopicDcpsParticipant)
    say(
        heard=summary(listener, heard["DiagnosticArray"][-int(count) :]),
        publications=listener.endpoints(BuiltinTopicDcpsPublication),
        subscriptions=listener.endpoints(BuiltinTopicDcpsSubscription),
        participants=[
            [each.key.hex, user_data(each)]
            for each in participants.take(10)
            if each.key != listener.participant.guid
        ],
    )
    say(answer=listener.call(name, 41))
    say(answer=listener.call(name, 42))
    listener.requests = None  # the client goes, which its service is told
    say(gone=True)
    while True:
        listener.wait()
        _, last = heard["DiagnosticArray"][-1]
        if {pair.key: pair.value for pair in last.status[0].values}["session"] == "9":
            break
    say(end=True)
    sys.stdin.read()  # until the test ends


if __name__ == "__main__":
    main(*sys.argv[1:])
