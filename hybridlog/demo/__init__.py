"""A simulated robot, and the demonstration that uses it.

Importing this package is fast: the simulation (numpy), the writer
(rosbags) and the tour are separate modules.
"""
