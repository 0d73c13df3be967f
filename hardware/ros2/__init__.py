"""Readings as live ROS 2 topics, and a service, over DDS alone: no ROS is needed.

`names` has ROS 2's names on the wire, `dds_types` its types, `participant` what ROS 2 expects of a
process, `tare_service` a service, `skin_node` the node that `eitskin live --ros2` runs.
"""
