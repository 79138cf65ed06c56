"""Counters of what a query reads."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

Paths = Collection[str] | None
"""Dotted paths of fields to read; None for all."""


@dataclass(slots=True)
class ScanCounts:
    """Counts of what was read for a query.

    Attributes:
        files: Paths of the files of tables, and of payloads, that were read.
        groups: Files and numbers of the row groups that were read.
        chunks: Chunks that were read.
        payload_bytes: Bytes of payloads that were decoded.
    """

    files: set[str] = field(default_factory=set)
    groups: set[tuple[str, int]] = field(default_factory=set)
    chunks: int = 0
    payload_bytes: int = 0

    @property
    def row_groups(self) -> int:
        """Number of row groups that were read."""
        return len(self.groups)

    def add_group(self, path: Path, group: int) -> None:
        """Count a row group."""
        self.files.add(str(path))
        self.groups.add((str(path), group))
