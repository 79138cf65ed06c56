"""Writes recordings: the recorder, its capture, losses and marks.

Imports: maintenance, query, schema.
"""
