"""Readings as ROS 2 messages, in MCAP files and as live topics over DDS; no ROS is needed.

`messages` makes messages of a reading, `mcap` writes them to a file, `participant` is a process as
ROS 2 expects it on the wire, and `skin_node` the node that `eitskin live --ros2` runs.
"""
