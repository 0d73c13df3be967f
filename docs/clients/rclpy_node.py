"""Node of rclpy that publishes the skin's readings; docs/ros2.md has the topics.

Untested: it was run with stand-ins of rclpy and rosidl_runtime_py only. It needs ROS 2 and
'eitskin[live,ros]' in one Python.

    python rclpy_node.py PIPELINE BOARD [NAME]
"""

import sys
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosidl_runtime_py.utilities import get_message

from eitskin.hardware import LiveReadings, Reading, open_board
from eitskin.hardware.ros2.messages import RosMessages
from eitskin.training import open_pipeline


class Skin(Node):
    """Node `skin` in a namespace that is the skin's name."""

    def __init__(self, name: str = "eitskin") -> None:
        super().__init__("skin", namespace=name)
        self._messages, self._session = RosMessages(name), None
        self._about = self._messages.topic("sensor")
        self._topics = {topic: self._topic(topic) for topic in self._messages.types}

    def _topic(self, topic: str) -> Any:
        profile = QoSProfile(depth=10)
        if topic == self._about:  # latched: who comes late gets it
            profile = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        return self.create_publisher(get_message(self._messages.types[topic]), topic, profile)

    def publish(self, reading: Reading) -> None:
        """Publish one reading, stamped with the time at which its frame came."""
        said = self._messages.make_messages(reading, round(1e9 * reading.wall_time))
        if reading.frame.session != self._session:
            self._session = reading.frame.session
            said |= self._messages.sensor(reading.frame)
        for topic, message in said.items():
            self._topics[topic].publish(self._messages.serialise(topic, message))  # CDR


def main() -> None:
    """Publish until the session ends."""
    rclpy.init()
    pipeline, node = open_pipeline(sys.argv[1]), Skin(*sys.argv[3:4])
    with LiveReadings(open_board(sys.argv[2]), pipeline) as readings:
        for reading in readings:
            node.publish(reading)


if __name__ == "__main__":
    main()
