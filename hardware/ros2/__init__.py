"""Readings as ROS 2 messages, in MCAP files and as live topics over DDS; no ROS is needed.

`messages` makes messages of a reading and writes them to a file, `skin_node` is the node that
`eitskin live --ros2` runs, in a process as ROS 2 expects it on the wire.
"""
