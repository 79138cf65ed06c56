"""Playback: plays messages of a store to viewers over the Foxglove WebSocket protocol."""
