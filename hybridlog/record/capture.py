"""A recording in progress: its directory, its segments and its index.

Messages of log files and of running robots both go through a `Capture`. It starts the
recording, provides its writer, and completes or removes the recording.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Any

from msgspec import convert
from msgspec.structs import replace

from hybridlog.entries import (
    ended,
    free_name_in,
    listed,
    put_entry,
    recording_metadata,
    text,
)
from hybridlog.maintenance.retention import Rules
from hybridlog.query.latching import depth_of
from hybridlog_storage.catalog import RecordingEntry
from hybridlog_storage.disk.directory import LOCK_WAIT_S
from hybridlog_storage.errors import (
    DatabaseError,
    DiskFullError,
    HybridlogError,
)
from hybridlog_storage.manifest import Loss, Manifest, Source, new_id
from hybridlog_storage.manifest import replace as replaced
from hybridlog_storage.segments.segment_format import losses_record
from hybridlog_storage.segments.segment_writer import RecordingWriter, SegmentSettings

if TYPE_CHECKING:
    from hybridlog.follow.child import FollowerProcess
    from hybridlog.snapshot import Snapshot
    from hybridlog_storage.catalog import Catalog
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.segments.segment_file import Sealed


class Capture:
    """Records the messages of one new recording.

    `follow` starts its follower; `known` returns all recordings of the store as they are now.
    `on_written` and `make_room` are as of `RecordingWriter`. `no_index` tells whether the messages
    of a topic get no documents in MongoDB. Files of a ring go while it is recorded, so latched
    messages have files of their own. `check` is called with all recordings before anything is
    written, while no other process can start one; it raises to refuse.

    Attributes:
        entry: The recording's catalog entry.
        writer: Writer of its segments.
        follower: Makes what is derived of it.
    """

    def __init__(
        self,
        directory: StoreDirectory,
        catalog: Catalog,
        follow: Callable[[RecordingEntry], FollowerProcess],
        known: Callable[[], Snapshot],
        *,
        name: str,
        tags: Mapping[str, str],
        source: Mapping[str, Any],
        settings: SegmentSettings,
        on_written: Callable[[], None] | None = None,
        no_index: Callable[[str], bool] | None = None,
        is_ring: bool = False,
        check: Callable[[Snapshot], None] = lambda _: None,
        make_room: Callable[[], bool] = lambda: False,
    ) -> None:
        self.catalog = catalog
        self._directory = directory
        self._make_room = make_room
        rules = Rules.of(directory.settings.retention)
        largest = int(min(settings.segment_size, rules.segment_size))
        settings = replace(settings, segment_size=largest)
        self._end: Callable[[Manifest], Manifest] | None = None
        self._held = ExitStack()
        recording = new_id(name)
        with self._held:
            try:
                with directory.manifests.creating() as create:
                    # Of two processes that record the same content now, one is refused.
                    recorded = known()
                    check(recorded)
                    manifest = Manifest(
                        recording,
                        free_name_in(recorded.summaries, name),
                        time.time_ns(),
                        source=convert(dict(source), Source),
                        tags={text(key): text(value) for key, value in tags.items()},
                    )
                    # First the recording's folder, locked, then its manifest.
                    lock = directory.writing(
                        recording, wait_s=LOCK_WAIT_S, records=True, makes=True
                    )
                    self._held.enter_context(lock)
                    create(manifest)
                    self.entry = put_entry(directory, catalog, recording)
            except BaseException:
                with suppress(HybridlogError):
                    directory.manifests.remove(recording)
                raise
            self._held = self._held.pop_all()
        folder = directory.recording(recording)
        self.follower = follow(self.entry)
        self.writer = RecordingWriter(
            folder,
            recording_metadata(self.entry.manifest),
            settings,
            no_index=no_index or (lambda _: False),
            is_named=lambda topic: rules.topic_rule(topic) is not None,
            is_latched=lambda channel: depth_of(channel) > 0,
            latched_apart=is_ring,
            on_sealing=self._announce,
            make_room=make_room,
            on_written=on_written,
        )

    @property
    def indexed(self) -> int:
        """Number of messages in the index, after the end."""
        return max(0, self.follower.state.indexed - (self.entry.messages - self.entry.documents))

    @property
    def lag(self) -> int:
        """Messages that are to be in the index, and are not yet."""
        state = self.follower.state
        return max(self.writer.totals.messages - state.indexed, 0) if state.is_wanted else 0

    def close(self, losses: Sequence[Loss] = ()) -> DatabaseError | None:
        """Complete the recording, which is damaged if its source had `losses`.

        `entry` is then complete, too.

        Returns:
            Why the index is not complete, None when it is.
        """
        # From here on only the last group is sealed, which announces the end.
        self.writer.flush()
        self._end = ended("damaged" if losses else "complete", losses)
        self.writer.close()
        return self._finish()

    def close_truncated(self, lost: Sequence[Loss]) -> DatabaseError | None:
        """Complete the recording on a full disk.

        Returns:
            Why the index is not complete, None when it is.

        Raises:
            DiskFullError: No room for that either. Without any message, the recording is gone.
        """
        self._end = ended("complete")  # the segment holds the last losses
        try:
            self.writer.close_truncated([losses_record(lost)])
        except DiskFullError:
            if not self.writer.written.total():
                self.rollback()
                raise
            if not self.writer.has_extras:  # or else the next look reads them in the segment
                with suppress(DiskFullError):
                    self._change(lambda now: replaced(now, losses=(*now.losses, *lost)))
            raise
        return self._finish()

    def _announce(self, group: Sequence[Sealed]) -> None:
        """List the segments of a group in the manifest before they get their final names."""
        end, change = self._end, listed(*group)
        self._change(change if end is None else lambda now: end(change(now)))

    def _change(self, how: Callable[[Manifest], Manifest]) -> None:
        while True:
            try:
                self._directory.manifests.change(self.entry.id, how)
                return
            except DiskFullError:
                from hybridlog.maintenance.keep import use_spare

                if not (self._make_room() or use_spare(self._directory)):
                    raise

    def _finish(self) -> DatabaseError | None:
        self.entry = put_entry(self._directory, self.catalog, self.entry.id)
        self.entry = self.follower.finish(self.entry)
        self._held.close()
        return self.follower.state.failure

    def abort(self) -> None:
        """Stop at once; flushed messages stay, and are sealed by the next change of the store."""
        self.writer.abort()
        self.follower.abandon()
        self._held.close()

    def rollback(self) -> None:
        """Remove the whole recording; what fails is finished by the next change of the store."""
        entry, manifests = self.entry, self._directory.manifests
        with suppress(HybridlogError):  # or else the files go first
            manifests.change(entry.id, lambda now: replaced(now, status="removed"))
        self.writer.abort()
        self.follower.abandon()
        with suppress(HybridlogError):
            manifests.remove(entry.id)
        with suppress(HybridlogError):
            self.catalog.remove(entry.id)
        self._held.close()
