"""Reads files of payloads: content of chunks byte for byte, and columns."""

from __future__ import annotations

import threading
from collections import OrderedDict, defaultdict
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import pyarrow as pa

from hybridlog.payloads.clouds import PointLayout
from hybridlog.payloads.columns import ArrayColumn, Rebuilder
from hybridlog.payloads.layout import IN_PAYLOADS
from hybridlog.payloads.zones import Zone
from hybridlog.tables.fields import original_name
from hybridlog.tables.parquet_file import ParquetFileReader, leaves_of
from hybridlog_storage import journal
from hybridlog_storage.directory import PAYLOADS
from hybridlog_storage.errors import SegmentError, StoreError
from hybridlog_storage.stopping import check_wanted

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence
    from pathlib import Path

    from hybridlog.payloads.columns import Rebuilt
    from hybridlog_storage.journal import PayloadFile
    from hybridlog_storage.messages import Buffer

_KEPT_GROUPS: Final = 3  # row groups of messages in memory: neighbouring chunks share one
_RESTORE = "Restore it from a copy; `hybridlog verify` shows what is affected."


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


class PayloadReader:
    """Reads one file. Thread safe.

    Args:
        folder: Folder that its name counts from.
        listed: The file as the journal lists it.

    Raises:
        StoreError: It is missing, damaged, or another file than the listed one.
    """

    def __init__(self, folder: Path, listed: PayloadFile) -> None:
        self.listed = listed
        path = folder / listed.file
        try:
            self.file = ParquetFileReader(path, depth=IN_PAYLOADS)
        except FileNotFoundError as error:
            raise StoreError(f"The payload file {path} is missing. {_RESTORE}") from error
        if (self.file.size_bytes, self.file.digest) != (listed.bytes, listed.digest):
            raise StoreError(
                f"The payload file {path} is not the one that the journal lists. {_RESTORE}"
            )
        about = self.file.about
        try:
            values = about.payloads
            layout = values["layout"]
            self.layout = None if layout is None else PointLayout.from_json(layout)
            self.arrays = [ArrayColumn.from_json(value) for value in values["arrays"]]
            self.order = [str(path) for path in values["order"]]
            self.is_ordered = bool(values["is_ordered"])
            self._rebuilder = Rebuilder(str(values["wire"]), self.arrays, self.order, self.layout)
            self.places = self._read_places(values["chunks"])
            self.zones = [
                {str(path): Zone.from_json(zone) for path, zone in group.items()}
                for group in values["zones"]
            ]
            if len(self.zones) != self.file.groups:
                raise ValueError("its row groups and its zones differ")
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise StoreError(f"The description in {path} is invalid: {error!r}.") from error
        self._columns = [".".join(names) for names, _ in leaves_of(self.file.schema)]
        self._needed = self.leaves(self._rebuilder.needed)
        self._groups: OrderedDict[int, Rebuilt] = OrderedDict()
        self._lock = threading.Lock()

    def _read_places(self, chunks: Any) -> dict[tuple[int, int], Place]:
        found: dict[tuple[int, int], Place] = {}
        if len(chunks) != self.file.groups:
            raise ValueError("its row groups and its chunks differ")
        for group, inside in enumerate(chunks):
            at = 0
            for segment, chunk, rows in inside:
                found[int(segment), int(chunk)] = Place(group, at, int(rows))
                at += int(rows)
            if at != self.file.about.bounds[group][0]:
                raise ValueError("its row groups and its chunks differ")
        return found

    def leaves(self, columns: Iterable[str]) -> list[int]:
        """Numbers of columns in the file's order.

        Args:
            columns: Dotted paths; one includes everything below it.
        """
        wanted = tuple(columns)
        return [
            number
            for number, name in enumerate(self._columns)
            if any(name == path or name.startswith(f"{path}.") for path in wanted)
        ]

    def size(self, groups: Iterable[int], columns: Collection[str]) -> int:
        """Stored bytes of columns of some row groups."""
        leaves = self.leaves(columns)
        return sum(self.file.size(group, leaves) for group in groups)

    def table(self, group: int, columns: Collection[str]) -> pa.Table:
        """Columns of a row group.

        Raises:
            StoreError: They are damaged.
        """
        check_wanted()
        return self.file.read(group, self.leaves(columns))

    def columns_of(self, kind: Any) -> list[str] | None:
        """Dotted paths of the columns of some fields; None if one has no such column.

        Args:
            kind: Type of messages with these fields.
        """
        found: list[str] = []
        return found if _find_columns(list(self.file.schema), list(kind), "", found) else None

    def rebuilt(self, group: int) -> Rebuilt:
        """The message records of a row group.

        Raises:
            StoreError: It is damaged.
        """
        with self._lock:
            found = self._groups.get(group)
            if found is not None:
                self._groups.move_to_end(group)
                return found
        table = self.file.read(group, self._needed)
        try:
            found = self._rebuilder.records(table)
        except (ValueError, pa.ArrowException) as error:
            raise StoreError(f"The payload file {self.file.path} is invalid: {error}.") from error
        with self._lock:
            self._groups[group] = found
            while len(self._groups) > _KEPT_GROUPS:
                self._groups.popitem(last=False)
        return found

    def check(self) -> None:
        """Read every byte and every value.

        Raises:
            StoreError: A part is damaged.
        """
        self.file.check()


def _find_columns(columns: list[Any], fields: list[Any], prefix: str, found: list[str]) -> bool:
    """Add the paths of the columns of some fields; False if one is missing."""
    by_name = {original_name(column): column for column in columns}
    for field in fields:
        column = by_name.get(field.name)
        if column is None:
            return False
        path = f"{prefix}{column.name}"
        if not pa.types.is_struct(field.type):
            found.append(path)
            continue
        if not pa.types.is_struct(column.type) or field.type.num_fields == 0:
            return False  # a message without fields is a boolean
        if not _find_columns(list(column.type), list(field.type), f"{path}.", found):
            return False
    return True


class RecordingPayloads:
    """The files of payloads of one recording. Thread safe.

    Args:
        recording: The recording's directory.
        listed: The files that its journal lists.
        folder: Name of the folder that holds them.

    Attributes:
        listed: The files.
    """

    def __init__(
        self, recording: Path, listed: Sequence[PayloadFile], folder: str = PAYLOADS
    ) -> None:
        self.listed = listed
        self._folder = recording / folder
        self._readers: dict[str, PayloadReader] = {}
        self._places: dict[tuple[int, int], list[PayloadReader]] | None = None
        self._problem = ""  # of a file that cannot be read
        self._lock = threading.RLock()

    @classmethod
    def of(cls, recording: Path) -> RecordingPayloads:
        """The files that the journal of a recording lists.

        Raises:
            StoreError: The journal cannot be read.
        """
        state = journal.read(recording)
        return cls(recording, [] if state is None else list(state.payloads.values()))

    def reader(self, listed: PayloadFile) -> PayloadReader:
        """The reader of a file.

        Raises:
            StoreError: The file is missing or damaged.
        """
        with self._lock:
            found = self._readers.get(listed.file)
            if found is None:
                found = self._readers[listed.file] = PayloadReader(self._folder, listed)
            return found

    def ordered(self, topic: str) -> list[PayloadReader] | None:
        """The readers of a topic, in order of time; None if rows are in another order.

        Raises:
            StoreError: A file is missing or damaged.
        """
        readers = [self.reader(file) for file in self.listed if file.topic == topic]
        if not readers or not all(reader.is_ordered for reader in readers):
            return None
        readers.sort(key=lambda reader: reader.file.about.bounds[0][1:3])
        ends = [r.file.about.bounds[-1][3:] for r in readers]
        starts = [r.file.about.bounds[0][1:3] for r in readers]
        if any(end >= start for end, start in zip(ends[:-1], starts[1:], strict=True)):
            return None
        return readers

    def content(self, segment: int, chunk: int, size: int) -> Buffer:
        """The uncompressed content of a chunk.

        Args:
            segment: Number of its segment.
            chunk: Its number there.
            size: Its bytes.

        Raises:
            SegmentError: Its messages are missing or damaged.
        """
        try:
            return self._content(segment, chunk, size)
        except SegmentError:
            raise
        except StoreError as error:
            raise SegmentError(str(error)) from error

    def _content(self, segment: int, chunk: int, size: int) -> Buffer:
        readers = self.having(segment, chunk)
        content = np.empty(size, np.uint8)
        filled = 0
        for reader in readers:
            place = reader.places[segment, chunk]
            rebuilt = reader.rebuilt(place.group)
            rows = slice(place.begin, place.begin + place.rows)
            starts, bounds = rebuilt.place[rows].tolist(), rebuilt.offset
            ends = bounds[place.begin + 1 : place.begin + place.rows + 1].tolist()
            for start, begin, end in zip(starts, bounds[rows].tolist(), ends, strict=True):
                if not 0 <= start <= size - (end - begin):
                    raise SegmentError("a message lies outside of its chunk")
                content[start : start + end - begin] = rebuilt.data[begin:end]
                filled += end - begin
        if filled != size:
            raise SegmentError(
                self._problem or f"{size - filled} bytes of its content are in no file of columns"
            )
        return content.data

    def having(self, segment: int, chunk: int) -> list[PayloadReader]:
        """The readers of files with messages of a chunk, but for damaged or missing files."""
        with self._lock:
            if self._places is None:
                places = defaultdict(list)
                for listed in self.listed:
                    try:
                        reader = self.reader(listed)
                    except StoreError as error:
                        self._problem = str(error)
                        continue
                    for key in reader.places:
                        places[key].append(reader)
                self._places = dict(places)
            return self._places.get((segment, chunk), [])
