"""Reads foreign MCAP files, from ROS 2 (rosbag2), ROS 1 or anything else."""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from mcap import records
from msgspec.structs import replace

from hybridlog.formats.reading import Damage, Source, cannot_open
from hybridlog.wording import listed
from hybridlog_storage.errors import SourceError
from hybridlog_storage.mcap import mcap_content
from hybridlog_storage.mcap.mcap_content import MAGIC, ChunkContent
from hybridlog_storage.mcap.mcap_scan import Item, Scan
from hybridlog_storage.messages import Batch, Channel, Schema, distinct
from hybridlog_storage.segments.segment_format import Attachment, reader_of
from hybridlog_storage.times import END, span_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from mcap.summary import Summary
    from numpy.typing import NDArray


_Definition: TypeAlias = records.Schema | records.Channel
_UNDEFINED = -1
_IDS = 1 << 16


class McapSource(Source):
    """One MCAP file, read forward.

    Definitions come from the data; those of the summary replace definitions lost with a
    damaged chunk. A channel id that is redefined with other content is another channel from
    there on. Messages on a channel with an undefined schema are read without a schema.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, kind="MCAP", profile="", files=[path])
        # The present meaning of ids, and indexes of channels by id; negative if it is not known.
        self._schemas: dict[int, records.Schema] = {}
        self._records: dict[int, records.Channel] = {}
        self._table = np.full(_IDS, _UNDEFINED, np.int32)
        self._made: dict[tuple[object, ...], int] = {}  # indexes of channels by what they say
        try:
            with path.open("rb") as file:
                # Attachments outlive this reader.
                self._items = self._open(reader_of(file.fileno()))
        except OSError as error:
            raise cannot_open(path, error) from error
        self._given = 0

    def _open(self, read: Callable[[int, int], bytes]) -> Iterator[tuple[int, Item]]:
        if read(0, len(MAGIC)) != MAGIC:
            raise SourceError(
                f"{self.path}: not an MCAP file, it does not start with the bytes of one; "
                "check that the file was copied whole"
            )
        scan = Scan(read, self.size_bytes)
        if scan.summary is not None:
            # It repeats all definitions, also those in unreadable chunks.
            for schema in scan.summary.schemas.values():
                self._define(schema)
            for channel in scan.summary.channels.values():
                self._define(channel)
            if scan.summary.statistics is not None:
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
        self.bytes_read = self.size_bytes
        for number in self._records:  # without messages
            self._use(number)
        if self.message_count is not None:
            self.settle(self.message_count, self._given)

    def _take(self, offset: int, item: Item) -> Iterator[Batch]:
        if isinstance(item, ChunkContent):
            yield from self._content(item, offset)
        elif isinstance(item, mcap_content.Damage):
            self.note(Damage(self.path, item.offset, item.length, item.reason, item.messages))
        elif isinstance(item, records.Schema | records.Channel):
            self._define(item)
        elif isinstance(item, records.Metadata | Attachment):
            self.extras.append(item)

    def _content(self, content: ChunkContent, offset: int) -> Iterator[Batch]:
        """Yield the messages of one chunk or run, whose channels change where definitions do."""
        batch = content.batch
        found = np.empty(len(batch), np.int32)
        row = 0
        for definition in content.definitions:
            known = self._known(definition.record)
            if definition.row > row and known is not None and known != definition.record:
                found[row : definition.row] = self._channels(batch.channel[row : definition.row])
                row = definition.row
            self._define(definition.record)
        found[row:] = self._channels(batch.channel[row:])
        is_known = found >= 0
        if not is_known.all():
            lost = int((~is_known).sum())
            names = listed(map(str, distinct(batch.channel[~is_known]).tolist()), 5)
            reason = f"{lost} messages on channels that are not defined ({names})"
            self.note(Damage(self.path, offset, None, reason, lost))
            batch, found = batch.take(is_known), found[is_known]
        if len(batch):
            self._given += len(batch)
            yield replace(batch, channel=found)

    def _channels(self, ids: NDArray[np.int32]) -> NDArray[np.int32]:
        """Indexes of channels by the definitions so far; negative if there is none."""
        # Sorting takes longer than a few rows.
        for number in set(ids.tolist()) if len(ids) < 10 else distinct(ids).tolist():
            self._use(number)
        return self._table[ids]

    def _known(self, record: _Definition) -> _Definition | None:
        own = self._schemas if isinstance(record, records.Schema) else self._records
        return own.get(record.id)

    def _define(self, record: _Definition) -> None:
        """Apply this definition from now on."""
        if self._known(record) == record:
            return
        if isinstance(record, records.Channel):
            self._records[record.id] = record
            self._table[record.id] = _UNDEFINED
        elif record.id:  # MCAP: a schema with id 0 is to be ignored
            self._schemas[record.id] = record
            self._table[:] = _UNDEFINED

    def _use(self, number: int) -> None:
        """Enter a channel id in the table, if it is defined."""
        record = self._records.get(number)
        if record is None or self._table[number] != _UNDEFINED:
            return
        said = self._schemas.get(record.schema_id)
        schema = None if said is None else Schema(said.name, said.encoding, said.data)
        metadata = tuple(sorted(record.metadata.items()))
        key = (number, record.topic, record.message_encoding, metadata, schema)
        if key not in self._made:
            made = Channel(record.topic, record.message_encoding, schema, record.metadata)
            self._made[key] = self.add_channel(made)
        self._table[number] = self._made[key]


def _time_range(summary: Summary) -> tuple[int, int] | None:
    """The log time by the chunk indexes; statistics are wrong in some logs."""
    indexes = [i for i in summary.chunk_indexes if i.message_start_time or i.message_end_time]
    start = min((index.message_start_time for index in indexes), default=END)
    last = max((index.message_end_time for index in indexes), default=-1)
    return span_of(start, last) if start <= last <= END else None
