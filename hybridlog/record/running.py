"""A recording that goes on: what is sealed, and what is flushed besides.

Its entry is like that of an ended recording, as of one moment. The catalog has what is sealed;
the rest is read from the open segments, each byte once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace

from hybridlog.entries import loss_values
from hybridlog.record.losses import Cause, joined
from hybridlog.snapshot import UNFINISHED
from hybridlog_storage.catalog import RecordingEntry, channel_entry, channel_totals
from hybridlog_storage.disk.directory import StoreDirectory, is_stable
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.manifest import Loss
from hybridlog_storage.segments.segment_file import OPEN_SUFFIX
from hybridlog_storage.segments.walk import Walk

if TYPE_CHECKING:
    from hybridlog_storage.messages import Schema


class RunningRecording:
    """Follows a recording while it is written. Not thread safe.

    Args:
        directory: The store.
        recording: Id of the recording.
        sealed: Returns its entry with what is sealed; None if it is gone.

    Attributes:
        schemas: Schemas of segments that are not sealed, by hash.
    """

    def __init__(
        self,
        directory: StoreDirectory,
        recording: str,
        sealed: Callable[[], RecordingEntry | None],
    ) -> None:
        self._directory, self._recording, self._read_sealed = directory, recording, sealed
        self._state = "", False  # the look of its directory, and whether it is being written
        self._sealed: RecordingEntry | None = None
        self._entry: RecordingEntry | None = None
        self._segments: dict[int, Walk] = {}
        self._unreadable: dict[int, str] = {}  # why, by number of the segment
        self.schemas: dict[str, Schema] = {}

    def follow(self) -> RecordingEntry | None:
        """The recording with what was flushed, sealed or begun since; None if it is gone.

        Raises:
            StoreError: Its files cannot be read.
        """
        look = self._directory.looks([self._recording]).get(self._recording, "")
        state = look, self._directory.is_recorded(self._recording)
        is_new = state != self._state
        if is_new:
            self._begin()
        for number, segment in self._segments.items():
            before = self._unreadable.pop(number, "")
            try:
                is_new |= segment.follow()
            except SegmentError as error:  # the other ones answer
                self._unreadable[number] = str(error)
            is_new |= self._unreadable.get(number, "") != before
        if is_new:
            # What is created within a tick of the file system's clock leaves the look as it is.
            self._state = state if is_stable(look) else ("", False)
            self._entry = None if self._sealed is None else self._with_flushed(self._sealed)
        return self._entry

    def _begin(self) -> None:
        """Read again what is sealed, and open the segments that are not."""
        # Listed first: what is sealed meanwhile is then in neither, or in both.
        opened = self._directory.listing(self._recording).open
        sealed = self._sealed = self._read_sealed()
        before, self._segments, self._unreadable = self._segments, {}, {}
        if sealed is None or sealed.status not in UNFINISHED:
            return
        path = self._directory.recording(self._recording)
        for number in opened:
            if str(number) not in sealed.digests:
                try:
                    self._segments[number] = before.get(number) or Walk.opened(path, number)
                except SegmentError as error:
                    self._unreadable[number] = str(error)

    def _with_flushed(self, sealed: RecordingEntry) -> RecordingEntry:
        """The entry with what is flushed besides."""
        channels = {one.id: replace(one, stats=replace(one.stats)) for one in sealed.channels}
        found = replace(sealed, spans=list(sealed.spans), flushed=dict(sealed.flushed))
        for number, segment in self._segments.items():
            found.flushed[number] = segment.flushed
            table, attachments, metadata, _ = segment.flushed
            for own, channel in segment.channels.items():
                if own not in channels:
                    channels[own] = one = channel_entry(own, channel)
                    if channel.schema is not None and one.schema is not None:
                        self.schemas[one.schema] = channel.schema
            for own, stats in channel_totals(table).items():
                channels[own].stats.add(stats)
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
        found.losses = self._losses(sealed.losses)
        return found

    def _losses(self, sealed: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
        """The loss ledger: what sealed segments and flushed records say, and what is damaged."""
        flushed = [loss_values(row) for one in self._segments.values() for row in one.losses]
        damaged: list[tuple[int, str, int | None, int | None]] = [
            (number, damage.reason, damage.offset, damage.length)
            for number, segment in self._segments.items()
            for damage in segment.damaged
        ]
        damaged += [(number, reason, None, None) for number, reason in self._unreadable.items()]
        return [
            *joined([*(row for row in sealed if row["cause"] != Cause.SEGMENT), *flushed]),
            *(row for row in sealed if row["cause"] == Cause.SEGMENT),
            *(  # an unknown number of messages at unknown times
                loss_values(
                    Loss(
                        Cause.SEGMENT,
                        reason=reason,
                        file=f"{number:06d}{OPEN_SUFFIX}",
                        offset=offset,
                        length=length,
                    )
                )
                for number, reason, offset, length in damaged
            ),
        ]
