"""Segments: MCAP files in chunks, with the recovery of those that a crash left open.

Imports: disk, mcap.
"""
