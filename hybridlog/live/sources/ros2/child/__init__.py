"""The child process of the ROS 2 source, which runs under the robot's own Python.

Its modules must run under Python 3.10 with rclpy (from Humble on) and the standard library.
So must `sequence_gaps`, which they use. The recorder uses `outbox`, too.
"""
