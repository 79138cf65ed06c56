"""Readers of foreign logs: ROS 1 bags, ROS 2 bags, MCAP."""
