"""Bags of ROS 1 and ROS 2: what holds messages, what a message says of an attitude, and what its frames are."""
