"""Recordings that go on, compared with the sequence that is written."""
