"""One file of columns, the columns to read for some fields, and what is open."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Collection, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import pyarrow as pa

from hybridlog.columns.fields import SUMMARY_FIELDS, is_of_bytes, names_of
from hybridlog.columns.layout import Section, TopicCounts
from hybridlog.columns.parquet_file import Leaf, ParquetFileReader, leaves
from hybridlog_storage.disk import files
from hybridlog_storage.lazy import lazy

if TYPE_CHECKING:
    from hybridlog_storage.cache import Cache

_OPEN_FILES: Final = 256
_MAX_FIELD_SETS: Final = 64  # sets of fields whose columns are known for a file
FIRST: Final = -(1 << 63)
"""Lower bound of all log times."""
LAST: Final = (1 << 63) - 1
"""Upper bound of all log times."""


class TablePart(NamedTuple):
    """Rows of one topic in a row group, in order.

    Attributes:
        file: The file.
        group: Number of the row group.
        begin: First row of the topic in it.
        rows: Number of its rows.
        first: A lower bound of their log times, ns.
        last: An upper bound of these.
    """

    file: ColumnFile
    group: int
    begin: int
    rows: int
    first: int = FIRST
    last: int = LAST


class ColumnFile(ParquetFileReader):
    """A file of tables, and what is known of its columns."""

    @lazy
    def leaves(self) -> list[Leaf]:
        """Its columns in Parquet's order."""
        return list(leaves(self.schema))

    @lazy
    def summaries(self) -> dict[tuple[str, ...], int]:
        """Paths of arrays with summaries, and the number of a column of each."""
        return {leaf.array: n for n, leaf in enumerate(self.leaves) if leaf.array is not None}

    @lazy
    def paths(self) -> set[tuple[str, ...]]:
        """Paths of fields that the messages have."""
        names = [leaf.array or leaf.names for leaf in self.leaves if not leaf.is_own]
        return {path[:end] for path in names for end in range(1, len(path) + 1)}

    @lazy
    def own(self) -> set[str]:
        """Columns of the table itself."""
        return {leaf.top for leaf in self.leaves if leaf.is_own}

    @lazy
    def arrays(self) -> set[tuple[str, ...]]:
        """Paths of arrays with summaries that tables with arrays have in full."""
        of_bytes = {
            leaf.names
            for leaf in self.leaves
            if leaf.array is None and not leaf.is_own and is_of_bytes(leaf.kind)
        }
        return self.summaries.keys() - of_bytes

    @lazy
    def summary_paths(self) -> set[tuple[str, ...]]:
        """Paths of the numbers of summaries."""
        return {leaf.names for leaf in self.leaves if leaf.array is not None}

    @lazy
    def chosen(self) -> dict[tuple[Any, ...], list[int]]:
        """Numbers of columns that were chosen, by what `choose` was asked for."""
        return {}

    def choose(
        self, paths: Collection[str] | None, own: Collection[str], *, arrays: bool = False
    ) -> list[int]:
        """Numbers of the columns for some fields.

        Args:
            paths: Dotted paths of fields; None for all.
            own: Columns of the table itself.
            arrays: True if all rows have `arrays` in full, and their summaries.
        """
        key = None if paths is None else frozenset(paths), frozenset(own), arrays
        found = self.chosen.get(key)
        if found is None:
            wanted = None if paths is None else list(map(names_of, paths))
            full = self.arrays if arrays else set()
            found = [
                number
                for number, leaf in enumerate(self.leaves)
                if (leaf.top in own if leaf.is_own else self._is_wanted(leaf, wanted, full))
            ]
            # A summary tells whether the array is there.
            known = {self.leaves[number].array for number in found}
            for array, number in self.summaries.items():
                if array in full:
                    continue
                if array not in known and any(p[: len(array)] == array for p in wanted or ()):
                    found.append(number)
            found.sort()
            if len(self.chosen) >= _MAX_FIELD_SETS:
                self.chosen.clear()
            self.chosen[key] = found
        return found

    def by_top(
        self, paths: Collection[str] | None, own: Collection[str], *, arrays: bool = False
    ) -> dict[str, tuple[int, ...]]:
        """The numbers of `choose` by the table's column that contains them."""
        found: dict[str, tuple[int, ...]] = {}
        for number in self.choose(paths, own, arrays=arrays):
            top = self.leaves[number].top
            found[top] = (*found.get(top, ()), number)
        return found

    def _is_wanted(
        self,
        leaf: Leaf,
        wanted: Sequence[tuple[str, ...]] | None,
        full: Collection[tuple[str, ...]],
    ) -> bool:
        if leaf.array in full:
            return wanted is not None and leaf.names in wanted
        if wanted is None or any(leaf.names[: len(path)] == path for path in wanted):
            return True
        # A summary is worked out from the array where that is there.
        summarised = self.summaries.keys() - full
        return any(
            leaf.names[: len(path) - 1] == path[:-1] and path[:-1] in summarised
            for path in wanted
            if leaf.array is None and path[-1] in SUMMARY_FIELDS
        )

    def sections(self) -> Iterator[tuple[int, Section]]:
        """The rows in it, each section with its first row."""
        before = 0
        for section in self.about.sections:
            yield before, section
            before += section.rows

    def parts(self, begin: int, rows: int) -> Iterator[TablePart]:
        """Row groups with some rows of one topic."""
        time = next(number for number, leaf in enumerate(self.leaves) if leaf.top == "t")
        before = 0
        for group, count in enumerate(self.groups):
            low, high = max(begin, before), min(begin + rows, before + count)
            if low < high:
                bounds = self.bounds(group, time) or (FIRST, LAST)
                yield TablePart(self, group, low - before, high - low, *bounds)
            before += count

    @lazy
    def counts(self) -> TopicCounts:
        """Counts of all its rows."""
        return TopicCounts(
            *map(sum, zip(*(one.counts for one in self.about.sections), strict=True))
        )

    def all_parts(self) -> list[TablePart]:
        """All rows, as if they were of one topic."""
        return [TablePart(self, group, 0, rows) for group, rows in enumerate(self.groups)]


class OpenFiles:
    """The files that were read last, and their decoded columns. Thread safe."""

    def __init__(self, cache: Cache) -> None:
        self._cache = cache
        self._open: OrderedDict[int, ColumnFile] = OrderedDict()
        self._lock = threading.Lock()

    def column(self, file: ColumnFile, group: int, top: str, leaves: tuple[int, ...]) -> Any:
        """A column of a row group, or the requested parts of it."""

        def read() -> Any:
            self.opened(file)
            found = file.read(group, leaves).column(0).combine_chunks()
            return pa.concat_arrays(found.chunks) if isinstance(found, pa.ChunkedArray) else found

        key = file.number, group, top, leaves
        return self._cache.made("column", *key, make=read, size_of=lambda one: int(one.nbytes))

    def opened(self, file: ColumnFile) -> None:
        """Close files that were not read lately, if too many are open."""
        with self._lock:
            self._open[file.number] = file
            self._open.move_to_end(file.number)
            while len(self._open) > files.most_open(_OPEN_FILES):
                self._open.popitem(last=False)[1].release()

    def clear(self) -> None:
        """Forget all columns and files."""
        self._cache.drop("column")
        with self._lock:
            self._open.clear()
