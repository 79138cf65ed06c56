"""The child process; it runs under the robot's Python (3.10 or newer, rclpy, nothing else)."""
