"""Live sources of messages: ROS 1, ROS 2, Foxglove, and the replay of a log."""
