"""The command line: it parses and prints; the library decides. Imports: any."""

from __future__ import annotations

from hybridlog.cli.app import main

__all__ = ["main"]
