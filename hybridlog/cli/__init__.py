"""The command line: it parses and prints; the library decides."""

from __future__ import annotations

from hybridlog.cli.app import main

__all__ = ["main"]
