"""Reads foreign MCAP files, from ROS 2 (rosbag2), ROS 1 or anything else."""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING

import numpy as np
from mcap import records
from msgspec.structs import replace

from hybridlog.formats.reading import (
    TOO_MANY_CHANNELS,
    TOO_MANY_SILENT,
    Damage,
    Source,
    cannot_open,
    split,
)
from hybridlog.wording import listed
from hybridlog_storage.errors import SourceError
from hybridlog_storage.mcap import mcap_content
from hybridlog_storage.mcap.mcap_content import MAGIC, ChunkContent
from hybridlog_storage.mcap.mcap_scan import Item, Scan
from hybridlog_storage.messages import MAX_CHANNELS, Channel, Schema, distinct
from hybridlog_storage.segments.segment_format import Attachment, reader_of
from hybridlog_storage.times import END, span_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from mcap.summary import Summary
    from numpy.typing import NDArray

    from hybridlog_storage.messages import Batch

_UNDEFINED = -1
_TOO_MANY = -2  # one more than a recording can hold
_IDS = 1 << 16


class McapSource(Source):
    """One MCAP file, read forward.

    Definitions come from the data; those of the summary replace definitions lost with a
    damaged chunk. A channel id that is redefined with other content is another channel from
    there on. Messages on a channel with an undefined schema are read without a schema, and
    `damage` notes it.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, kind="MCAP", profile="", files=[path])
        try:
            with path.open("rb") as file:
                # Attachments outlive this reader.
                self._items = self._open(reader_of(file.fileno()))
        except OSError as error:
            raise cannot_open(path, error) from error
        self._given = 0
        self._too_many = 0
        self._unpublished = 0

    def _open(self, read: Callable[[int, int], bytes]) -> Iterator[tuple[int, Item]]:
        if read(0, len(MAGIC)) != MAGIC:
            raise SourceError(
                f"{self.path}: not an MCAP file, it does not start with the bytes of one; "
                "check that the file was copied whole"
            )
        scan = Scan(read, self.size_bytes)
        self._definitions = _Definitions(self.channels, scan.summary)
        if scan.summary is not None and scan.summary.statistics is not None:
            self.message_count = scan.summary.statistics.message_count
            self.time_range = _time_range(scan.summary)
        items = scan.items()
        first = next(items, None)
        if first is None:
            return items
        if isinstance(first[1], records.Header):
            self.profile = first[1].profile
            if self.profile == "ros2":
                self.kind = "ROS 2 bag (mcap)"
        return chain([first], items)

    def close(self) -> None:
        """Close the file."""
        self._items = iter(())

    def batches(self) -> Iterator[Batch]:
        """Yield all readable messages once, in file order."""
        try:
            for offset, item in self._items:
                self.bytes_read = max(self.bytes_read, offset)
                yield from self._take(offset, item)
        except OSError as error:
            raise cannot_open(self.path, error) from error
        self._end()

    def _take(self, offset: int, item: Item) -> Iterator[Batch]:
        if isinstance(item, ChunkContent):
            yield from self._content(item, offset)
        elif isinstance(item, mcap_content.Damage):
            self.note(Damage(self.path, item.offset, item.length, item.reason, item.messages))
        elif isinstance(item, records.Schema | records.Channel):
            self._definitions.add(item)
        elif isinstance(item, records.Metadata | Attachment):
            self.extras.append(item)

    def _content(self, content: ChunkContent, offset: int) -> Iterator[Batch]:
        """Yield the messages of one chunk or run, split where a definition changes."""
        self._unpublished += content.unpublished
        batch = content.batch
        found = np.empty(len(batch), np.int32)
        row = 0
        for definition in content.definitions:
            if definition.row > row and self._definitions.changes(definition.record):
                self._resolve(batch.channel, found, slice(row, definition.row), offset)
                row = definition.row
            self._definitions.add(definition.record)
        self._resolve(batch.channel, found, slice(row, len(batch)), offset)
        yield from self._rows(batch, found, offset)

    def _resolve(
        self, ids: NDArray[np.int32], found: NDArray[np.int32], rows: slice, offset: int
    ) -> None:
        """Set the channels of some rows by the definitions so far."""
        wanted = ids[rows]
        # Sorting takes longer than a few rows.
        numbers = set(wanted.tolist()) if len(wanted) < 10 else distinct(wanted).tolist()
        for number in numbers:
            reason = self._definitions.use(number)
            if reason:
                self._tell(reason, 0, offset)
        found[rows] = self._definitions.table[wanted]

    def _rows(self, rows: Batch, found: NDArray[np.int32], offset: int) -> Iterator[Batch]:
        """Yield rows on the channels `found` in batches of bounded size."""
        known = found >= 0
        if not known.all():
            many = found == _TOO_MANY
            self._too_many += int(many.sum())
            lost = int((found == _UNDEFINED).sum())
            if lost:
                undefined = distinct(rows.channel[found == _UNDEFINED]).tolist()
                names = listed(map(str, undefined), 5)
                reason = f"{lost} messages on channels that are not defined ({names})"
                self._tell(reason, lost, offset)
            rows, found = rows.take(known), found[known]
        if not len(rows):
            return
        self._given += len(rows)
        yield from split(replace(rows, channel=found))

    def _tell(self, reason: str, lost: int, offset: int | None = None) -> None:
        self.note(Damage(self.path, offset, None, reason, lost))

    def _end(self) -> None:
        self.bytes_read = self.size_bytes
        if left_out := self._definitions.use_rest():
            self._tell(f"{left_out} {TOO_MANY_SILENT}", 0)
        if self._too_many:
            self._tell(TOO_MANY_CHANNELS, self._too_many)
        if self._unpublished:
            reason = (
                f"{self._unpublished} messages have a publish time beyond 2^63 - 1 ns; their log "
                "time is stored in its place"
            )
            self._tell(reason, 0)
        if self.message_count is not None:
            self.settle(self.message_count, self._given)


def _time_range(summary: Summary) -> tuple[int, int] | None:
    """The log time by the summary, if its parts agree."""
    statistics = summary.statistics
    if statistics is None or not statistics.message_count:
        return None
    start, last = statistics.message_start_time, statistics.message_end_time
    indexes = [i for i in summary.chunk_indexes if i.message_start_time or i.message_end_time]
    if indexes:
        by_chunks = (
            min(index.message_start_time for index in indexes),
            max(index.message_end_time for index in indexes),
        )
        if by_chunks != (start, last):
            return None
    return span_of(start, last) if start <= last <= END else None


class _Definitions:
    """The present meaning of each MCAP channel id.

    Attributes:
        table: int32[65536], index in the source's channels by channel id, negative if the id
            is undefined or unused, or one too many.
    """

    def __init__(self, channels: list[Channel], summary: Summary | None) -> None:
        self.table = np.full(_IDS, _UNDEFINED, np.int32)
        self._channels = channels
        self._schemas: dict[int, records.Schema] = {}
        self._records: dict[int, records.Channel] = {}
        self._schema_ids = np.zeros(_IDS, np.int32)  # by channel id
        self._made: dict[tuple[object, ...], int] = {}  # indexes of channels by what they say
        # The summary repeats all definitions, also those in unreadable chunks.
        if summary is not None:
            for schema in summary.schemas.values():
                self.add(schema)
            for channel in summary.channels.values():
                self.add(channel)

    def changes(self, record: records.Schema | records.Channel) -> bool:
        """True if this definition changes the meaning of an id."""
        known = self._known(record)
        return known is not None and known != record

    def add(self, record: records.Schema | records.Channel) -> None:
        """Apply this definition from now on."""
        if self._known(record) == record:
            return
        if isinstance(record, records.Channel):
            self._records[record.id] = record
            self._schema_ids[record.id] = record.schema_id
            self.table[record.id] = _UNDEFINED
        elif record.id:  # MCAP: a schema with id 0 is to be ignored
            self._schemas[record.id] = record
            self.table[self._schema_ids == record.id] = _UNDEFINED

    def _known(
        self, record: records.Schema | records.Channel
    ) -> records.Schema | records.Channel | None:
        return (self._schemas if isinstance(record, records.Schema) else self._records).get(
            record.id
        )

    def use(self, channel_id: int) -> str:
        """Enter this id, if defined; returns the problem of its definition once, else ''."""
        record = self._records.get(channel_id)
        if record is None or self.table[channel_id] != _UNDEFINED:
            return ""
        said = self._schemas.get(record.schema_id)
        schema = None if said is None else Schema(said.name, said.encoding, said.data)
        metadata = tuple(sorted(record.metadata.items()))
        key = (channel_id, record.topic, record.message_encoding, metadata, schema)
        index = self._made.get(key)
        if index is not None:
            self.table[channel_id] = index
            return ""
        if len(self._channels) >= MAX_CHANNELS:
            self.table[channel_id] = _TOO_MANY
            return ""
        self.table[channel_id] = self._made[key] = len(self._channels)
        made = Channel(record.topic, record.message_encoding, schema, record.metadata)
        self._channels.append(made)
        if schema is None and record.schema_id:
            return (
                f"schema {record.schema_id} of channel {channel_id} ({record.topic}) is not "
                "defined; its messages are kept without one"
            )
        return ""

    def use_rest(self) -> int:
        """Enter the channels without messages; returns how many there is no room for."""
        rest = [number for number in self._records if self.table[number] == _UNDEFINED]
        for number in rest:
            self.use(number)
        return int((self.table[rest] == _TOO_MANY).sum())
