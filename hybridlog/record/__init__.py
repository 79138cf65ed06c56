"""Writes recordings: the recorder, its capture, losses and marks."""
