"""Recording a running robot under load, beside `rosbag record`, and when things fail."""
