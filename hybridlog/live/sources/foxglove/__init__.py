"""Foxglove: a client of a Foxglove WebSocket server."""
