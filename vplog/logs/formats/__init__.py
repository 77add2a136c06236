"""Bytes of MCAP, ROS 1 and ROS 2 files to raw messages, with an account of what is lost."""
