"""Live ROS 2 topics, heard in another process by types written from ROS 2's own definitions."""

import json
import os
import runpy
import select
import signal
import subprocess
import sys
import types
import uuid
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from eitskin.errors import ConfigurationError, DataError
from eitskin.hardware import Reading
from eitskin.hardware.ros2.messages import RosMessages
from eitskin.hardware.ros2.skin_node import (
    dds_service,
    dds_type_name,
    require_domain,
    require_name,
)
from eitskin.simulator import Frame, Protocol
from eitskin.training import TouchEstimate

from live_fakes import Estimate

pytest.importorskip("cyclonedds")

from eitskin.hardware.ros2.skin_node import SkinNode

pytestmark = pytest.mark.slow
LISTENER = Path(__file__).parents[1] / "support" / "ros2_listener.py"
RCLPY_NODE = Path(__file__).parents[2] / "docs" / "clients" / "rclpy_node.py"
NAME = "left_hand/skin"
FRAMES = 6
PROTOCOL = Protocol.pairwise(8)


def loopback_only(tag):
    """Configuration of Cyclone DDS by which only this test's processes hear each other."""
    return (
        "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo' multicast='true'/>"
        "</Interfaces></General><Discovery>"
        f"<ParticipantIndex>auto</ParticipantIndex><Tag>{tag}</Tag>"
        "<Peers><Peer address='localhost'/></Peers></Discovery></Domain></CycloneDDS>"
    )


def reading(number, session=0):
    rng = np.random.default_rng(number)
    estimate = Estimate(touches=(TouchEstimate(0.05, 0.02, 9.5, 1e-3, 0.9),))
    values = rng.random(28) + 1j * rng.random(28)
    return Reading(Frame(values, PROTOCOL, 0.3 * number, number, session), estimate, 0.004, 3.3)


class Heard:
    """Listener in another process, to which readings are published until it says something."""

    def __init__(self, node):
        self.node, self.number = node, 0
        self.process = subprocess.Popen(
            [sys.executable, str(LISTENER), "0", NAME, str(FRAMES)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )

    def publish(self, session=0):
        self.node.publish(reading(self.number, session))
        self.number += 1

    def next(self):
        """The next line that the listener says."""
        for _ in range(30_000):
            if select.select([self.process.stdout], [], [], 0.01)[0]:
                break
            self.publish()
        else:
            pytest.fail("the listener hears nothing")
        line = self.process.stdout.readline()
        assert line, "the listener ended"
        return json.loads(line)


@pytest.fixture(scope="module")
def session():
    """What a listener heard of a node, was answered, and got after it had been stopped."""
    taken = []

    def tare(frames):
        taken.append([frame.number for frame in frames])
        if len(taken) == 2:
            raise DataError("the sensor moves")
        return "mean of 4 frames"

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CYCLONEDDS_URI", loopback_only(uuid.uuid4()))
        patch.delenv("ROS_DISTRO", raising=False)
        clock = iter(range(10**18, 2 * 10**18, 10**8))
        node = SkinNode(NAME, tare=tare, tare_frames=4, now=lambda: next(clock))
        listener = Heard(node)
        try:
            facts = listener.next()
            facts["answers"] = [listener.next()["answer"] for _ in range(2)]
            assert listener.next()["gone"]
            os.kill(listener.process.pid, signal.SIGSTOP)
            for _ in range(300):
                listener.publish()
            listener.publish(session=9)
            os.kill(listener.process.pid, signal.SIGCONT)
            facts["end"] = json.loads(listener.process.stdout.readline())
            listener.process.kill()
            listener.process.communicate()
            for _ in range(50):
                listener.publish()
            facts |= {"taken": taken, "refused": node.refused}
        finally:
            listener.process.kill()
            listener.process.communicate()
            node.close()
    return facts


def test_messages_arrive_in_order_with_stamps_of_their_frames(session):
    """Their bytes are those of MCAP files, which rosbags reads back in `test_mcap`."""
    heard = session["heard"]
    numbers = [int(number) for number in heard["numbers"]]
    assert numbers == list(range(numbers[0], numbers[0] + FRAMES))
    assert heard["status"] == [
        [0, f"{NAME}: sensor", "touch", NAME],
        [0, f"{NAME}: channels", "all channels are good", NAME],
    ]
    first, *others = session["heard"]["stamps"]
    assert (first + 4_000_000) % 10**8 == 0  # the clock, less the latency
    assert np.diff([first, *others]).tolist() == [10**8] * (FRAMES - 1)
    (text,) = session["heard"]["sensor"]
    assert json.loads(text)["protocol"]["table"] == [list(row) for row in PROTOCOL.table]
    assert f"/{NAME}/bend" in json.loads(text)["units"]


def test_the_graph_has_the_names_types_and_hashes_of_ros_and_their_owner(session):
    offered = {each["topic"]: each for each in session["publications"]}
    types = RosMessages(NAME).types
    expected = {f"rt{topic}": dds_type_name(kind) for topic, kind in types.items()}
    expected["ros_discovery_info"] = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_"
    expected[f"rr/{NAME}/tareReply"] = "std_srvs::srv::dds_::Trigger_Response_"
    assert {topic: each["type"] for topic, each in offered.items()} == expected
    assert all(each["reliable"] and each["cdr"] for each in offered.values())
    assert {each["waits"] for each in offered.values()} == {0}
    latched = {topic for topic, each in offered.items() if each["latched"]}
    assert latched == {f"rt/{NAME}/sensor", "ros_discovery_info"}
    # The hash that ROS 2 itself gives std_msgs/msg/String.
    known = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
    assert offered[f"rt/{NAME}/sensor"]["data"] == f"typehash={known};"
    (request,) = session["subscriptions"]
    assert (request["topic"], request["type"]) == (
        f"rq/{NAME}/tareRequest",
        "std_srvs::srv::dds_::Trigger_Request_",
    )
    assert request["data"] == offered[f"rr/{NAME}/tareReply"]["data"] != ""
    ((participant, data),) = session["participants"]
    assert data == "enclave=/;"
    (node,) = session["heard"]["nodes"]
    assert node["name"] == f"/{NAME}/skin"
    keys = {each["key"] for each in session["publications"] if each["topic"][0] == "r"}
    keys -= {each["key"] for each in session["publications"] if "discovery" in each["topic"]}
    assert set(node["writers"]) == keys
    assert node["readers"] == [each["key"] for each in session["subscriptions"]]
    assert all(key.startswith(participant[:24]) for key in keys)
    assert require_name("/left_hand/skin/") == NAME
    assert dds_service("/a/tare") == ("rq/a/tareRequest", "rr/a/tareReply")
    for name in ("", "/", "2nd", "a b", "a//b", "a__b", "a-b", "ä", 161 * "a"):
        with pytest.raises(ConfigurationError, match="namespace"):
            require_name(name)
    for domain in (-1, 233):
        with pytest.raises(ConfigurationError, match="ROS_DOMAIN_ID"):
            require_domain(domain)


def test_the_service_answers_and_stopped_subscribers_hold_nothing_up(session):
    first, second = session["taken"]
    assert [np.diff(each).tolist() for each in (first, second)] == [[1, 1, 1]] * 2
    assert second[0] > first[-1]
    assert session["answers"] == [
        {"client": 7, "sequence_number": 41, "success": True, "message": "mean of 4 frames"},
        {"client": 7, "sequence_number": 42, "success": False, "message": "the sensor moves"},
    ]
    assert session["end"]
    assert session["refused"] == 0


class StandInForNode:
    """What `rclpy_node.py` uses of a node of rclpy."""

    def __init__(self, name, namespace):
        self.node, self.published, self.latched = (namespace, name), [], set()

    def create_publisher(self, kind, topic, profile):
        if profile.get("durability") == "latched":
            self.latched.add(topic)

        def publish(data):
            self.published.append((topic, kind, data))

        return types.SimpleNamespace(publish=publish)


def test_the_node_of_rclpy_publishes_what_the_mcap_files_have(monkeypatch):
    durability = types.SimpleNamespace(TRANSIENT_LOCAL="latched")
    names = {
        "rclpy": {},
        "rclpy.node": {"Node": StandInForNode},
        "rclpy.qos": {"DurabilityPolicy": durability, "QoSProfile": dict},
        "rosidl_runtime_py": {},
        "rosidl_runtime_py.utilities": {"get_message": str},
    }
    for name, contents in names.items():
        module = types.ModuleType(name)
        vars(module).update(contents)
        monkeypatch.setitem(sys.modules, name, module)
    node = runpy.run_path(str(RCLPY_NODE))["Skin"](NAME)
    readings = [replace(reading(number), wall_time=10.0 + number) for number in range(2)]
    for each in readings:
        node.publish(each)
    messages = RosMessages(NAME)
    expected = list(messages.make_messages(readings[0], 10 * 10**9).items())
    expected += messages.sensor(readings[0].frame).items()
    expected += messages.make_messages(readings[1], 11 * 10**9).items()
    assert node.published == [
        (topic, messages.types[topic], messages.serialise(topic, message))
        for topic, message in expected
    ]
    assert node.node == (NAME, "skin")
    assert node.latched == {f"/{NAME}/sensor"}
