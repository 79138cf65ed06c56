"""A recording that goes on: what is sealed, and what is flushed besides.

Its entry is like that of an ended recording, as of one moment. The catalog has what is sealed;
the rest is read from the open segments, each byte once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace

from hybridlog.entries import loss_values, topic_types
from hybridlog.record.losses import Cause, joined
from hybridlog.snapshot import UNFINISHED
from hybridlog_storage.catalog import ChannelEntry, channel_entry, channel_totals
from hybridlog_storage.disk.directory import is_stable
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.manifest import Loss
from hybridlog_storage.segments.segment_file import OPEN_SUFFIX
from hybridlog_storage.segments.walk import Walk

if TYPE_CHECKING:
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.messages import Schema
    from hybridlog_storage.summary import TopicType


class RunningRecording:
    """Follows a recording while it is written. Not thread safe.

    Args:
        directory: The store.
        recording: Id of the recording.
        sealed: Returns its entry by the catalog, with what is sealed; None if it is gone.

    Attributes:
        entry: The recording at the last look; None if it is gone.
        topics: Its topics and their types.
        schemas: Schemas of segments that are not sealed, by hash.
    """

    def __init__(
        self,
        directory: StoreDirectory,
        recording: str,
        sealed: Callable[[], RecordingEntry | None],
    ) -> None:
        self._directory = directory
        self._recording = recording
        self._read_sealed = sealed
        self._sealed: RecordingEntry | None = None
        self._state = "", False  # the look of its directory, and whether it is being written
        self._segments: dict[int, Walk] = {}
        self._unreadable: dict[int, str] = {}  # why, by number of the segment
        self.entry: RecordingEntry | None = None
        self.topics: frozenset[TopicType] = frozenset()
        self.schemas: dict[str, Schema] = {}

    def follow(self) -> bool:
        """See what was flushed, sealed or begun since.

        Returns:
            True if the entry has changed.

        Raises:
            StoreError: Its files cannot be read.
        """
        look = self._directory.looks([self._recording]).get(self._recording, "")
        state = look, self._directory.is_recorded(self._recording)
        is_same = state == self._state
        if not is_same:
            self._begin()
        before = dict(self._unreadable)
        is_new = False
        for number, segment in self._segments.items():
            with self._noting(number):
                is_new |= segment.follow()
        if is_same and not is_new and before == self._unreadable:
            return False
        # What is created within a tick of the file system's clock leaves the look as it is.
        self._state = state if is_stable(look) else ("", False)
        self.entry = None if self._sealed is None else self._with_flushed(self._sealed)
        self.topics = frozenset() if self.entry is None else topic_types(self.entry)
        return True

    @contextmanager
    def _noting(self, number: int) -> Iterator[None]:
        """Note why a segment cannot be read; the other ones answer."""
        try:
            yield
            self._unreadable.pop(number, None)
        except SegmentError as error:
            self._unreadable[number] = str(error)

    def _begin(self) -> None:
        """Read again what is sealed, and open the segments that are not."""
        # Listed first: what is sealed meanwhile is then in neither, or in both.
        opened = self._directory.listing(self._recording).open
        self._sealed = self._read_sealed()
        before, self._segments = self._segments, {}
        self._unreadable.clear()
        if self._sealed is None or self._sealed.status not in UNFINISHED:
            return
        path = self._directory.recording(self._recording)
        for number in opened:
            if str(number) in self._sealed.digests:
                continue
            with self._noting(number):
                self._segments[number] = before.get(number) or Walk.opened(path, number)

    def _with_flushed(self, sealed: RecordingEntry) -> RecordingEntry:
        """The entry with what is flushed besides."""
        channels = {channel.id: replace(channel) for channel in sealed.channels}
        found = replace(sealed, spans=list(sealed.spans), flushed=dict(sealed.flushed))
        for number, segment in self._segments.items():
            found.flushed[number] = segment.flushed
            table, attachments, metadata, _ = segment.flushed
            self._add_channels(channels, segment)
            for channel_id, stats in channel_totals(table).items():
                total = channels[channel_id].stats = replace(channels[channel_id].stats)
                total.add(stats)
            if len(table.parts):
                span = int(table.parts["first"].min()), int(table.parts["last"].max())
                found.spans.append((number, *span))
                found.is_decoded = False
            found.stored_bytes += segment.end
            found.segments += 1
            found.chunks += len(table.chunks)
            found.attachments += len(attachments)
            found.metadata_records += len(metadata)
        found.channels = [channels[number] for number in sorted(channels)]
        found.losses = list(_losses(sealed, self._segments, self._unreadable))
        return found

    def _add_channels(self, channels: dict[int, ChannelEntry], segment: Walk) -> None:
        for number, channel in segment.channels.items():
            if number not in channels:
                channels[number] = found = channel_entry(number, channel)
                if channel.schema is not None and found.schema is not None:
                    self.schemas[found.schema] = channel.schema


def _losses(
    sealed: RecordingEntry, segments: Mapping[int, Walk], unreadable: Mapping[int, str]
) -> Iterator[dict[str, Any]]:
    """The loss ledger: what sealed segments and flushed records say, and what is damaged."""
    rows = [row for row in sealed.losses if row["cause"] != Cause.SEGMENT]
    flushed = (loss_values(row) for one in segments.values() for row in one.losses)
    yield from joined([*rows, *flushed])
    yield from (row for row in sealed.losses if row["cause"] == Cause.SEGMENT)
    for number, segment in segments.items():
        for damage in segment.damaged:
            yield _damaged(number, damage.reason, damage.offset, damage.length)
    for number, reason in unreadable.items():
        yield _damaged(number, reason)


def _damaged(
    number: int, reason: str, offset: int | None = None, length: int | None = None
) -> dict[str, Any]:
    """A row for an unknown number of messages at unknown times."""
    file = f"{number:06d}{OPEN_SUFFIX}"
    return loss_values(Loss(Cause.SEGMENT, reason=reason, file=file, offset=offset, length=length))
