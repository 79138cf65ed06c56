"""The command line: it parses and prints; the library decides."""

from __future__ import annotations

from hybridlog.cli.main import main

__all__ = ["main"]
