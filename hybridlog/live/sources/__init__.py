"""What a running robot says: ROS 1, ROS 2, Foxglove, or a log played as if it ran."""
