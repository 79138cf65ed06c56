"""Transforms between the coordinate frames of a robot, as tf2 gives them.

Imports: arrays, formats, frames, query, schema.
"""
