"""ROS 2: reads from a child process that runs under the Python that has rclpy."""
