"""Mechanism of hybridlog: bytes, files and MongoDB. Knows no ROS."""
