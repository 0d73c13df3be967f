"""Messages of an MCAP file, read by rosbags."""

from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from eitskin.hardware.ros2.messages import RosMessages

TYPES = RosMessages().types
STORE = get_typestore(Stores.ROS2_HUMBLE)


def read(path):
    """Stamps [ns] and messages by topic."""
    found = {}
    with Reader(path) as bag:
        for connection, stamp, data in bag.messages():
            assert connection.msgtype == TYPES[connection.topic]
            message = STORE.deserialize_cdr(data, connection.msgtype)
            found.setdefault(connection.topic, []).append((stamp, message))
    return found
