"""Types of Cyclone DDS, made from the definitions of ROS 2 messages that the MCAP files use."""

from typing import Any

from eitskin.hardware.ros2.names import dds_type_name

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

    def of(self, kind: str) -> Any:
        """Class of samples of a message type, such as sensor_msgs/msg/Image."""
        if kind not in self._made:
            _, fields = self._store.fielddefs[kind]
            self._made[kind] = _struct(kind, {name: self._field(each) for name, each in fields})
        return self._made[kind]

    def of_service(self, kind: str) -> Any:
        """Class of samples of one of `SERVICE_TYPES`, with the header of rmw_cyclonedds_cpp."""
        if kind not in self._made:
            fields = HEADER | SERVICE_TYPES[kind]
            self._made[kind] = _struct(kind, {name: _scalar(each) for name, each in fields.items()})
        return self._made[kind]

    def serialised(self, kind: str, data: bytes) -> Any:
        """Sample of a message type that is written as `data`, its CDR form."""
        sample = self.of(kind).__new__(self.of(kind))
        sample.serialize = lambda **_: data
        return sample

    def _field(self, description: Any) -> Any:
        """Type of a field from its description by rosbags."""
        from cyclonedds.idl import types
        from rosbags.interfaces import Nodetype

        node, inner = description
        if node == Nodetype.NAME:
            return self.of(inner)
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
