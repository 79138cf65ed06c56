"""ROS 2: starts a child process under the Python that has rclpy, and reads from it."""
