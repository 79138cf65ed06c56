"""Foxglove: a client of a WebSocket server."""
