"""A simulated robot, whose log is written as an ordinary ROS bag.

`python -m benchmarks.simulator robot.bag` writes the large bag of tests and benchmarks, 106 MB.
"""
