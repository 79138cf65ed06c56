"""A simulated robot, and the demonstration that uses it."""
