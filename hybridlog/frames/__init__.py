"""Tables of messages: columns to Arrow and pandas, index documents to columns."""

from __future__ import annotations

from hybridlog.frames.table import TableBuilder

__all__ = ["TableBuilder"]
