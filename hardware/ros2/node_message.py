"""Message by which ROS 2 learns what node has which writers and readers."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

TOPIC = "ros_discovery_info"
TYPE = "rmw_dds_common/msg/ParticipantEntitiesInfo"
OLD = ("foxy", "galactic", "humble")
"""Distributions whose identifiers have 24 bytes; later ones have 16. The message has one name in
both, so that a domain can hold only one kind."""


@dataclass(frozen=True)
class NodeDefinitions:
    """Definitions of the message.

    Attributes:
        store: type store of rosbags.
        size: bytes of an identifier.
    """

    store: Any
    size: int

    @classmethod
    def of_distribution(cls) -> "NodeDefinitions":
        """Definitions of the distribution in ROS_DISTRO; of the later ones where that is unset."""
        from rosbags.typesys import Stores, get_typestore

        if os.environ.get("ROS_DISTRO") in OLD:
            return cls(get_typestore(Stores.ROS2_HUMBLE), 24)
        return cls(get_typestore(Stores.ROS2_JAZZY), 16)

    def message(
        self,
        namespace: str,
        node: str,
        participant: Any,
        readers: Sequence[Any],
        writers: Sequence[Any],
    ) -> bytes:
        """CDR form of the message that gives one node of a participant its readers and writers."""
        make = self.store.types
        one = make["rmw_dds_common/msg/NodeEntitiesInfo"](
            node_namespace=f"/{namespace}",
            node_name=node,
            reader_gid_seq=[self._identifier(reader) for reader in readers],
            writer_gid_seq=[self._identifier(writer) for writer in writers],
        )
        said = make[TYPE](gid=self._identifier(participant), node_entities_info_seq=[one])
        return bytes(self.store.serialize_cdr(said, TYPE))

    def _identifier(self, entity: Any) -> Any:
        """Identifier of an entity of DDS: its GUID, filled up with zeros."""
        data = np.frombuffer(entity.guid.bytes.ljust(self.size, b"\0"), np.uint8)
        return self.store.types["rmw_dds_common/msg/Gid"](data=data)
