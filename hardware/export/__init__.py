"""Readings in files of other programs: MCAP with ROS 2 messages.

`ros_messages` makes messages of a reading, `mcap` writes them to a file.
"""
