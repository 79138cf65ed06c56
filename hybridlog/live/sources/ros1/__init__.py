"""ROS 1: a subscriber of our own, without any ROS installation."""
