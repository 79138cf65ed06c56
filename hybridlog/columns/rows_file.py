"""Files of rows: what is left of the messages of a log that is gone.

Such a file has the columns of a table, in the order of the chunks. Its `ref` also has the
sender's sequence number, size and SHA-256 of the payload, and whether bytes were left over
behind the message. Unlike a table it is never made again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import pyarrow as pa

from hybridlog.columns.column_file import ColumnFile
from hybridlog_storage.cache import Cache
from hybridlog_storage.errors import StoreError
from hybridlog_storage.manifest import File, Part, hasher, rows_line

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

RESTORE: Final = " Restore it from a copy; `hybridlog verify` shows what is affected."


class RowsFile(ColumnFile):
    """One file of rows: messages of a topic. Thread safe.

    `places` has the row group of each chunk, its first row and number of rows there.
    """

    def __init__(self, folder: Path, listed: File, cache: Cache | None = None) -> None:
        self.listed = listed
        self._cache = cache or Cache()
        path = folder / listed.name
        try:
            super().__init__(path)
        except FileNotFoundError as error:
            raise StoreError(f"The file of rows {path} is missing.{RESTORE}") from error
        except StoreError as error:
            raise StoreError(f"{error}{RESTORE}") from error
        rows = sum(part.messages for part in listed.parts.values())
        if (self.size_bytes, self.rows) != (listed.bytes, rows):
            raise self._other()
        try:
            self.topic = self.about.sections[0].topic
            self.places = self._read_places(self.about.of_rows["chunks"])
        except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
            raise StoreError(f"The description in {path} is invalid: {error!r}.") from error

    def check(self) -> str:
        """As of `ColumnFile`; it is the file that the manifest lists."""
        digest = super().check()
        if digest != self.listed.digest:
            raise self._other()
        return digest

    def _other(self) -> StoreError:
        return StoreError(
            f"The file of rows {self.path} is not the one that the manifest lists.{RESTORE}"
        )

    def _read_places(self, chunks: Any) -> dict[int, tuple[int, int, int]]:
        found: dict[int, tuple[int, int, int]] = {}
        if len(chunks) != len(self.groups):
            raise ValueError("its row groups and its chunks differ")
        for group, inside in enumerate(chunks):
            at = 0
            for chunk, rows in inside:
                found[int(chunk)] = (group, at, int(rows))
                at += int(rows)
            if at != self.groups[group]:
                raise ValueError("its row groups and its chunks differ")
        return found

    def of_chunk(self, chunk: int) -> pa.StructArray:
        """The rows of a chunk; a struct has all columns."""
        group, begin, rows = self.places[chunk]
        found = self._cache.made(
            "column",
            self.number,
            group,
            make=lambda: (
                self.read(group, range(len(self.leaves))).to_struct_array().combine_chunks()
            ),
            size_of=lambda one: int(one.nbytes),
        )
        return found.slice(begin, rows)


def lines_of(folder: Path, log: File, names: Iterable[str]) -> list[File]:
    """Lines of a manifest for files of rows of a log that none lists, from the first file on."""
    found = []
    for name in names:
        about = ColumnFile(folder / name).about
        data = (folder / name).read_bytes()
        parts = {int(n): Part(*part) for n, part in about.of_rows["parts"].items()}
        found.append(rows_line(log, name, len(data), hasher(data).hexdigest(), parts))
    return found
