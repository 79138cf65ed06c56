"""ROS 1: a subscriber in plain Python, without a ROS installation."""
