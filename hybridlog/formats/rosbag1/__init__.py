"""ROS 1 bags: reader and writer."""
