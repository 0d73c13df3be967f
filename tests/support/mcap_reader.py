"""Messages of an MCAP file, read by rosbags."""

from eitskin.hardware.ros2.messages import RosMessages


def read(path):
    """Stamps [ns] and messages by topic."""
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_typestore

    types, store = RosMessages().types, get_typestore(Stores.ROS2_HUMBLE)
    found = {}
    with Reader(path) as bag:
        for connection, stamp, data in bag.messages():
            assert connection.msgtype == types[connection.topic]
            message = store.deserialize_cdr(data, connection.msgtype)
            found.setdefault(connection.topic, []).append((stamp, message))
    return found
