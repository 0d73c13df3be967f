"""Names of ROS 2 on the wire: topics, services and types, as DDS has them.

Source: the design of ROS 2, "Topic and Service name mapping to DDS"
(https://design.ros2.org/articles/topic_and_service_names.html).
"""

import re

from eitskin.errors import ConfigurationError

LARGEST_DOMAIN = 232  # ports of UDP above 65535 would follow
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")


def dds_topic(topic: str) -> str:
    """Name of a topic, such as rt/tf for /tf."""
    return f"rt{topic}"


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
    if not _NAME.fullmatch(bare) or "__" in bare:
        raise ConfigurationError(
            "expected a ROS 2 namespace of letters, digits and single underscores, in parts that "
            f"begin with no digit, such as left_hand/skin, got '{name}'"
        )
    return bare


def require_domain(domain: int) -> int:
    """Check the number of a DDS domain and return it.

    Raises ConfigurationError outside 0 to 232.
    """
    if not 0 <= domain <= LARGEST_DOMAIN:
        raise ConfigurationError(
            f"expected a DDS domain of 0 to {LARGEST_DOMAIN}, got {domain}; take the robot's "
            "ROS_DOMAIN_ID"
        )
    return domain
