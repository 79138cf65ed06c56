"""Counters of what a query reads."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

Paths = Collection[str] | None
"""Dotted paths of fields to read; None for all."""


@dataclass(slots=True)
class ScanCounts:
    """Counts of what was read for a query.

    Attributes:
        files: Paths of the files of tables, and of payloads, that were read.
        row_groups: Row groups that were read.
        chunks: Chunks that were read.
        payload_bytes: Bytes of payloads that were decoded.
    """

    files: set[str] = field(default_factory=set)
    row_groups: int = 0
    chunks: int = 0
    payload_bytes: int = 0
