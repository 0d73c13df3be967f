"""Live readings in files of other programs: MCAP with ROS 2 messages."""
