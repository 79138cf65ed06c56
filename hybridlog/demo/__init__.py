"""A simulated robot, and the demonstration that uses it.

Importing this package imports nothing heavy: the simulation (numpy), the writer
(rosbags) and the tour are modules of their own.
"""
