"""Second participant of ROS 2's topics: what it hears of a skin, as lines of JSON.

The classes are typed from the .msg and .srv files of ROS 2's common_interfaces, geometry2 and
rmw_dds_common; nothing of eitskin is imported. Run: ros2_listener.py DOMAIN NAME FRAMES.
"""

import json
import sys
import time
from dataclasses import asdict, dataclass

from cyclonedds.builtin import (
    BuiltinDataReader,
    BuiltinTopicDcpsParticipant,
    BuiltinTopicDcpsPublication,
    BuiltinTopicDcpsSubscription,
)
from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import (
    array,
    bounded_str,
    byte,
    float64,
    int32,
    int64,
    sequence,
    uint8,
    uint32,
    uint64,
)
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class String(IdlStruct, typename="std_msgs::msg::dds_::String_"):
    data: str


@dataclass
class MultiArrayDimension(IdlStruct, typename="std_msgs::msg::dds_::MultiArrayDimension_"):
    label: str
    size: uint32
    stride: uint32


@dataclass
class MultiArrayLayout(IdlStruct, typename="std_msgs::msg::dds_::MultiArrayLayout_"):
    dim: sequence[MultiArrayDimension]
    data_offset: uint32


@dataclass
class Float64MultiArray(IdlStruct, typename="std_msgs::msg::dds_::Float64MultiArray_"):
    layout: MultiArrayLayout
    data: sequence[float64]


@dataclass
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    header: Header
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]


@dataclass
class Image(IdlStruct, typename="sensor_msgs::msg::dds_::Image_"):
    header: Header
    height: uint32
    width: uint32
    encoding: str
    is_bigendian: uint8
    step: uint32
    data: sequence[uint8]


@dataclass
class PointField(IdlStruct, typename="sensor_msgs::msg::dds_::PointField_"):
    name: str
    offset: uint32
    datatype: uint8
    count: uint32


@dataclass
class PointCloud2(IdlStruct, typename="sensor_msgs::msg::dds_::PointCloud2_"):
    header: Header
    height: uint32
    width: uint32
    fields: sequence[PointField]
    is_bigendian: bool
    point_step: uint32
    row_step: uint32
    data: sequence[uint8]
    is_dense: bool


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Transform(IdlStruct, typename="geometry_msgs::msg::dds_::Transform_"):
    translation: Vector3
    rotation: Quaternion


@dataclass
class TransformStamped(IdlStruct, typename="geometry_msgs::msg::dds_::TransformStamped_"):
    header: Header
    child_frame_id: str
    transform: Transform


@dataclass
class TFMessage(IdlStruct, typename="tf2_msgs::msg::dds_::TFMessage_"):
    transforms: sequence[TransformStamped]


@dataclass
class KeyValue(IdlStruct, typename="diagnostic_msgs::msg::dds_::KeyValue_"):
    key: str
    value: str


@dataclass
class DiagnosticStatus(IdlStruct, typename="diagnostic_msgs::msg::dds_::DiagnosticStatus_"):
    level: byte
    name: str
    message: str
    hardware_id: str
    values: sequence[KeyValue]


@dataclass
class DiagnosticArray(IdlStruct, typename="diagnostic_msgs::msg::dds_::DiagnosticArray_"):
    header: Header
    status: sequence[DiagnosticStatus]


@dataclass
class Gid(IdlStruct, typename="rmw_dds_common::msg::dds_::Gid_"):
    data: array[uint8, 16]


@dataclass
class NodeEntitiesInfo(IdlStruct, typename="rmw_dds_common::msg::dds_::NodeEntitiesInfo_"):
    node_namespace: bounded_str[256]
    node_name: bounded_str[256]
    reader_gid_seq: sequence[Gid]
    writer_gid_seq: sequence[Gid]


@dataclass
class ParticipantEntitiesInfo(
    IdlStruct, typename="rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_"
):
    gid: Gid
    node_entities_info_seq: sequence[NodeEntitiesInfo]


@dataclass
class TriggerRequest(IdlStruct, typename="std_srvs::srv::dds_::Trigger_Request_"):
    client: uint64  # rmw_cyclonedds_cpp's header
    sequence_number: int64
    structure_needs_at_least_one_member: uint8


@dataclass
class TriggerResponse(IdlStruct, typename="std_srvs::srv::dds_::Trigger_Response_"):
    client: uint64
    sequence_number: int64
    success: bool
    message: str


TOPICS = {
    "rt/{}/sensor": String,
    "rt/{}/impedance": Float64MultiArray,
    "rt/{}/bend": JointState,
    "rt/{}/touch_map": Image,
    "rt/{}/touches": PointCloud2,
    "rt/tf": TFMessage,
    "rt/diagnostics": DiagnosticArray,
    "ros_discovery_info": ParticipantEntitiesInfo,
}
LATCHED = ("rt/{}/sensor", "ros_discovery_info")
HEADER = b"\x00\x01"  # little-endian CDR of the first version, which ROS 2 reads

RELIABLE = Policy.Reliability.Reliable(max_blocking_time=duration(seconds=1))
CDR = Policy.DataRepresentation(use_cdrv0_representation=True)
DEFAULT = Qos(RELIABLE, Policy.Durability.Volatile, Policy.History.KeepLast(10), CDR)
SENSOR_DATA = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(5), CDR)
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
        self.heard = {kind.__name__: [] for kind in TOPICS.values()}
        self.readers = []
        for topic, kind in TOPICS.items():
            profile = KEPT if topic in LATCHED else SENSOR_DATA if kind is Image else DEFAULT
            self.read(topic.format(name), kind, profile)

    def read(self, topic, kind, profile=DEFAULT):
        reader = DataReader(self.participant, Topic(self.participant, topic, kind), qos=profile)
        any_state = ViewState.Any | SampleState.Any | InstanceState.Any
        self.waits.attach(ReadCondition(reader, any_state))
        self.readers.append((reader, kind.__name__))
        self.heard.setdefault(kind.__name__, [])

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
        topic = Topic(self.participant, f"rq/{name}/tareRequest", TriggerRequest)
        if not any(kind == "TriggerResponse" for _, kind in self.readers):
            self.read(f"rr/{name}/tareReply", TriggerResponse)
            self.requests = DataWriter(self.participant, topic, qos=DEFAULT)
        self.requests.write(TriggerRequest(7, sequence_number, 0))
        while len(self.heard["TriggerResponse"]) < 1:
            self.wait()
        return asdict(self.heard["TriggerResponse"].pop()[1])


def summary(listener, frames):
    """What was heard, as plain data."""
    last = {name: samples[-1][1] for name, samples in listener.heard.items() if samples}
    points, image, transforms = last["PointCloud2"], last["Image"], last["TFMessage"].transforms
    return {
        "stamps": [each.header.stamp.sec * 10**9 + each.header.stamp.nanosec for _, each in frames],
        "numbers": [
            next(pair.value for pair in each.status[0].values if pair.key == "number")
            for _, each in frames
        ],
        "status": [[s.level, s.name, s.message, s.hardware_id] for s in frames[-1][1].status],
        "sensor": [each.data for _, each in listener.heard["String"]],
        "impedance": list(last["Float64MultiArray"].data),
        "dimensions": [[d.label, d.size, d.stride] for d in last["Float64MultiArray"].layout.dim],
        "bend": [last["JointState"].name, list(last["JointState"].position)],
        "image": [image.height, image.width, image.encoding, bytes(image.data).hex()],
        "points": [points.width, [f.name for f in points.fields], bytes(points.data).hex()],
        "frame_id": points.header.frame_id,
        "tf": [
            [each.header.frame_id, each.child_frame_id, asdict(each.transform)]
            for each in transforms
        ],
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
