"""A file of columns that a recording's journal lists, with its rows by chunk."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from hybridlog.columns.column_file import ColumnFile
from hybridlog.columns.layout import IN_PAYLOADS
from hybridlog_storage.cache import Cache
from hybridlog_storage.errors import StoreError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from hybridlog_storage.journal import PayloadFile

RESTORE = " Restore it from a copy; `hybridlog verify` shows what is affected."


class Place(NamedTuple):
    """Rows of a chunk in a file.

    Attributes:
        group: Row group.
        begin: Its first row in the group.
        rows: Number of rows.
    """

    group: int
    begin: int
    rows: int


class ChunkFile(ColumnFile):
    """One file that the journal lists, of a topic. Thread safe.

    Args:
        folder: Folder that its name counts from.
        listed: The file as the journal lists it.
        cache: Keeps what was read.

    Attributes:
        listed: As above.
        places: Rows of each chunk, by segment and number.

    Raises:
        StoreError: It is missing, damaged, or another file than the listed one.
    """

    def __init__(self, folder: Path, listed: PayloadFile, cache: Cache | None = None) -> None:
        self.listed = listed
        self.cache = cache or Cache()
        path = folder / listed.file
        try:
            super().__init__(path, depth=IN_PAYLOADS)
        except FileNotFoundError as error:
            raise StoreError(f"The payload file {path} is missing.{RESTORE}") from error
        if (self.size_bytes, self.digest) != (listed.bytes, listed.digest):
            raise StoreError(
                f"The payload file {path} is not the one that the journal lists.{RESTORE}"
            )
        try:
            self._take(self.about.payloads)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise StoreError(f"The description in {path} is invalid: {error!r}.") from error

    def _take(self, values: Mapping[str, Any]) -> None:
        """Parse what the file says of itself; errors of any kind say that it is invalid."""
        self.places = self._read_places(values["chunks"])

    def _read_places(self, chunks: Any) -> dict[tuple[int, int], Place]:
        found: dict[tuple[int, int], Place] = {}
        if len(chunks) != self.groups:
            raise ValueError("its row groups and its chunks differ")
        for group, inside in enumerate(chunks):
            at = 0
            for segment, chunk, rows in inside:
                found[int(segment), int(chunk)] = Place(group, at, int(rows))
                at += int(rows)
            if at != self.about.bounds[group][0]:
                raise ValueError("its row groups and its chunks differ")
        return found
