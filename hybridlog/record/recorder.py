"""A recording in progress, and a log that becomes one: source to segments to index.

Messages of log files and of running robots both go through a `Capture`. It starts the recording,
provides its writer, and completes or removes the recording. A complete recording has everything
that could be read, and a loss ledger of everything that could not. A failed one leaves nothing.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import Struct, convert, field
from msgspec.structs import replace

from hybridlog.entries import (
    ended,
    free_name_in,
    put_entry,
    recording_metadata,
    text,
    with_segments,
)
from hybridlog.maintenance.retention import Rules
from hybridlog.query.latching import LatchedFront, depth_of
from hybridlog.schema.ros_codec import TRIED_MESSAGES, completed
from hybridlog.wording import listed
from hybridlog_storage.catalog import Catalog, RecordingEntry
from hybridlog_storage.disk.directory import LOCK_WAIT_S, StoreDirectory
from hybridlog_storage.errors import (
    AlreadyRecordedError,
    DatabaseError,
    DiskFullError,
    HybridlogError,
    SourceError,
    TopicError,
)
from hybridlog_storage.manifest import Loss, Manifest, new_id
from hybridlog_storage.manifest import Source as Origin
from hybridlog_storage.manifest import replace as replaced
from hybridlog_storage.messages import Batch, Channel, distinct
from hybridlog_storage.segments.segment_format import OUR_NAMES, Attachment, losses_record
from hybridlog_storage.segments.segment_writer import RecordingWriter, SegmentSettings
from hybridlog_storage.stopping import at_safe_points, safe_point
from hybridlog_storage.times import placed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.follow.child import FollowerProcess
    from hybridlog.formats.reading import Damage, Fingerprint, Source
    from hybridlog.query.topics import TopicMatcher
    from hybridlog.snapshot import Snapshot
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
                        source=convert(dict(source), Origin),
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
        return max(self.writer.messages - state.indexed, 0) if state.is_wanted else 0

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
        end, change = self._end, with_segments(*group)
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


_MAX_PARTS = 1000  # of a log, whose fingerprints the recording has


class RecordOptions(Struct, frozen=True):
    """Options of a recording.

    Attributes:
        name: Name of the recording; by default that of the file.
        tags: Tags of the recording.
        matcher: Selects topics; None for all.
        between: Log time `[begin, end)`, ns; None for all.
        latched: With `between`, also the latched messages that are in force when it begins.
        original_times: They keep their log time, instead of that of the beginning.
        again: True to record even if the same content is in the store.
        settings: Rotation, chunks and compression of segments.
        no_index: Selects topics whose messages get no documents in MongoDB; None for none.
    """

    name: str | None = None
    tags: Mapping[str, str] = field(default_factory=dict)
    matcher: TopicMatcher | None = None
    between: tuple[int, int] | None = None
    latched: bool = True
    original_times: bool = False
    again: bool = False
    settings: SegmentSettings = field(default_factory=SegmentSettings)
    no_index: TopicMatcher | None = None


class RecordReport(Struct):
    """The result of a recording.

    Attributes:
        entry: The recording's entry in the catalog.
        damage: Unreadable parts of the source.
        indexed: Messages in the index.
        missed: Stored messages whose index documents are missing.
        failure: The reason why they are missing.
        skipped: Messages left out by topic or time.
        elapsed_s: Wall time, seconds.
        latched: Latched messages from before the time range.
        latched_left_out: Those that were in force and did not fit in memory.
        remarks: What is odd about the source, where nothing is damaged or lost.
        not_indexed: Why the index has no fields of some channels, by id.
    """

    entry: RecordingEntry
    damage: list[Damage]
    indexed: int
    missed: int
    failure: DatabaseError | None
    skipped: int
    elapsed_s: float
    latched: int = 0
    latched_left_out: int = 0
    remarks: list[str] = field(default_factory=list)
    not_indexed: dict[int, str] = field(default_factory=dict)


@at_safe_points()
def record(
    source: Source,
    directory: StoreDirectory,
    catalog: Catalog,
    follow: Callable[[RecordingEntry], FollowerProcess],
    known: Callable[[], Snapshot],
    *,
    fingerprint: Fingerprint,
    options: RecordOptions,
    progress: Callable[[int, int], None] | None = None,
) -> RecordReport:
    """Record a whole source, which is open and not yet read; `fingerprint` is of its content.

    A signal stops it at safe points only, and then nothing is stored. `follow` and `known` are as
    of `Capture`. `progress` is called with bytes read and messages stored.

    Raises:
        AlreadyRecordedError: the same content is in the store.
        SourceError: nothing could be read.
        DiskFullError: no space; nothing is stored.
    """
    started = time.monotonic()
    capture = Capture(
        directory,
        catalog,
        follow,
        known,
        name=options.name or name_of(source.path),
        tags=options.tags,
        source={
            "path": text(str(source.path)),
            "kind": source.kind,
            "profile": source.profile,
            "bytes": source.size_bytes,
            "fingerprint": fingerprint.whole,
            "parts": fingerprint.parts if 1 < len(fingerprint.parts) <= _MAX_PARTS else (),
        },
        settings=options.settings,
        no_index=options.no_index,
        check=partial(_check_new, source, fingerprint, options),
    )
    try:
        copy = _Copy(source, capture.writer, options)
        copy.run(progress)
        _check_result(source, capture.writer, options)
        losses = [
            Loss(
                "source damaged",
                count=damage.messages_lost,
                reason=damage.reason,
                file=text(damage.file.name),
                offset=damage.offset,
                length=damage.length,
            )
            for damage in source.damage
        ]
        failure = capture.close(losses)
    except BaseException:
        # Remove a partial recording: the source still exists, the command can be repeated.
        capture.rollback()
        raise
    return RecordReport(
        capture.entry,
        list(source.damage),
        capture.indexed,
        capture.follower.state.missed,
        failure,
        copy.skipped,
        time.monotonic() - started,
        latched=copy.front.messages if copy.front is not None else 0,
        latched_left_out=copy.front.left_out if copy.front is not None else 0,
        remarks=[*source.remarks, *capture.follower.said],
    )


class _Copy:
    """Copies everything wanted from a source to a writer.

    Attributes:
        front: The latched messages in front of a slice; None for none.
        skipped: Messages left out.
    """

    def __init__(self, source: Source, writer: RecordingWriter, options: RecordOptions) -> None:
        self.front: LatchedFront | None = None
        if options.between is not None and options.latched:
            self.front = LatchedFront(options.between[0], original_times=options.original_times)
        self.skipped = 0
        self._source = source
        self._writer = writer
        self._between = options.between
        self._matcher = options.matcher
        self._wanted: list[bool] = []  # of the channels
        self._channels: list[Channel] = []  # completed by their first messages
        self._open: set[int] = set()  # numbers of those that are not yet

    def run(self, progress: Callable[[int, int], None] | None) -> None:
        """Copy the source from its beginning to its end."""
        source, writer = self._source, self._writer
        read = 0
        for batch in source.batches():
            safe_point()
            self._copy_extras()
            read += len(batch)
            chosen = self._chosen(batch)
            writer.append(chosen, self._completed(chosen))
            if progress is not None:
                progress(source.bytes_read, writer.messages)
        for batch in self.front.batches() if self.front is not None else ():
            writer.append(batch, self._completed(batch))
        self._copy_extras()
        for channel in self._all_channels():
            if self._matcher is None or self._matcher(channel.topic):
                writer.declare(channel)
        self.skipped = read - writer.messages

    def _chosen(self, batch: Batch) -> Batch:
        """The wanted messages of a batch."""
        channels = self._source.channels
        if self._matcher is not None:
            self._wanted += [self._matcher(one.topic) for one in channels[len(self._wanted) :]]
            batch = _where(batch, np.array(self._wanted, np.bool_)[batch.channel])
        if self._between is not None:
            begin, end = self._between
            times = placed(batch.log_time)
            inside = (times >= begin) & (times < end)
            if self.front is not None:
                inside = self.front.split(batch, inside, channels)
            batch = _where(batch, inside)
        return batch

    def _copy_extras(self) -> None:
        """Store attachments and metadata records; a slice holds the attachments up to its end."""
        for extra in self._source.extras:
            if isinstance(extra, Attachment):
                is_wanted = self._between is None or extra.log_time < self._between[1]
            else:
                is_wanted = not extra.name.startswith(OUR_NAMES)
            if is_wanted:
                self._writer.add_extra(extra)
        self._source.extras.clear()

    def _completed(self, batch: Batch) -> list[Channel]:
        """The channels of a batch, by their numbers in the source."""
        self._learn()
        if self._open and len(batch):
            for number in self._open.intersection(distinct(batch.channel).tolist()):
                rows = np.flatnonzero(batch.channel == number)
                some = rows[:: max(1, len(rows) // TRIED_MESSAGES)].tolist()
                payloads = [batch.payload(row) for row in some]
                self._channels[number] = completed(self._channels[number], payloads)
                self._open.discard(number)
        return self._channels

    def _all_channels(self) -> list[Channel]:
        """All channels of the source; those without messages are completed by proof only."""
        self._learn()
        for number in self._open:
            self._channels[number] = completed(self._channels[number], [])
        self._open.clear()
        return self._channels

    def _learn(self) -> None:
        known = len(self._channels)
        self._channels += self._source.channels[known:]
        self._open.update(range(known, len(self._channels)))


def _where(batch: Batch, mask: NDArray[np.bool_]) -> Batch:
    return batch if mask.all() else batch.take(mask)


def _check_result(source: Source, writer: RecordingWriter, options: RecordOptions) -> None:
    if not writer.messages and source.damage:
        first = source.damage[0]
        raise SourceError(f"{source.path}: no message could be read: {first.reason}")
    if options.matcher is not None and not writer.messages:
        topics = listed(sorted({c.topic for c in source.channels}), 20)
        raise TopicError(
            f"{source.path}: no message is on the topics asked for; the log has: {topics}"
        )


def _check_new(
    source: Source, fingerprint: Fingerprint, options: RecordOptions, snapshot: Snapshot
) -> None:
    whole = snapshot.by_fingerprint.get(fingerprint.whole)
    found = [whole] if whole else [*map(snapshot.by_fingerprint.get, fingerprint.parts)]
    names = dict.fromkeys(repr(one.name) for one in found if one is not None)
    if found and None not in found and not options.again:
        raise AlreadyRecordedError(
            f"{source.path} is in the store already, as {listed(names)}. "
            "Use --again to record it once more."
        )


def name_of(path: Path) -> str:
    """The name of the recording of a log, unless one is given."""
    name = path.resolve().name
    for suffix in (".active", ".zstd", ".bag", ".mcap", ".db3"):
        name = name.removesuffix(suffix)
    return name or "recording"
