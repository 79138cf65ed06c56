"""ROS 2 bags: directories with their metadata, and SQLite files."""
