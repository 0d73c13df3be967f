"""Options of `eitskin live --ros2`."""

from typing import Annotated

import typer

Ros2 = Annotated[
    bool, typer.Option("--ros2", help="Also publish frames and estimates as ROS 2 topics.")
]
Ros2Domain = Annotated[
    int, typer.Option(envvar="ROS_DOMAIN_ID", help="Number of the DDS domain, 0 to 232.")
]
Ros2Namespace = Annotated[
    str, typer.Option(help="Name of this skin, which its topics and its frame have.")
]
