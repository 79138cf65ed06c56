"""One recording while it is being made: its directory, its segments and its way to the index.

Whatever the messages come from, a log file or a running robot, they go through a
`Capture`: it starts the recording, gives them a writer, and either brings it to its end
or takes back that it was ever there.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from threading import BoundedSemaphore
from typing import TYPE_CHECKING, Any

from hybridlog.columns.gatherer import FieldGatherer
from hybridlog.entries import build_entry, new_key, recording_metadata
from hybridlog.index_writer import IndexWriter, Lag
from hybridlog.indexing import ChunkIndexer
from hybridlog_storage.catalog import Catalog, RecordingEntry
from hybridlog_storage.collection_names import collection_of
from hybridlog_storage.errors import DatabaseError, StoreError
from hybridlog_storage.segment_format import END_METADATA, LOSSES_METADATA, json_metadata
from hybridlog_storage.segment_writer import RecordingWriter, SegmentSettings

if TYPE_CHECKING:
    from hybridlog_storage.database import Database
    from hybridlog_storage.directory import StoreDirectory


@dataclass(frozen=True, slots=True)
class Pace:
    """What whoever cannot wait asks of segments and index.

    Attributes:
        hurry: Says whether there is more than can be handed over. Only chunks that shrink to
            little are compressed then.
        behind: Says whether there is so much more that the index waits, falls behind, and
            reads back later from the segments what is no longer in memory.
        has_room: Says whether so many bytes of chunks may wait for the index in memory.
        next_chunk_size: Gives the bytes at which a chunk closes that is opened now.
        spare: Processors for what can wait: to pack a chunk, where there is no hurry, and to
            make documents and columns of one.
        on_written: Called, on another thread, when less waits for the disk. Whoever appends
            never waits, and looks at `writer.waiting` instead.
        renew: Gives another connection to the index when one has failed.
    """

    hurry: Callable[[], bool]
    behind: Callable[[], bool]
    has_room: Callable[[int], bool]
    next_chunk_size: Callable[[], int]
    spare: BoundedSemaphore
    on_written: Callable[[], None]
    renew: Callable[[], Database]


class Capture:
    """Takes the messages of one new recording.

    Args:
        directory: The store.
        database: The index.
        name: Name of the recording.
        tags: Kept with it.
        source: What its messages come from, as the catalog shows it.
        settings: How segments are cut and packed.
        pace: Of whoever appends, if it cannot wait for compression, disk and index.
        check: Called with the catalog before anything is made, while nobody else can
            start a recording; raises to refuse.

    Attributes:
        entry: The recording's catalog entry.
        writer: Its segments.
        index: Its way to the index.
    """

    def __init__(
        self,
        directory: StoreDirectory,
        database: Database,
        *,
        name: str,
        tags: Mapping[str, str],
        source: Mapping[str, Any],
        settings: SegmentSettings,
        pace: Pace | None = None,
        check: Callable[[Catalog], None] | None = None,
    ) -> None:
        self.catalog = Catalog(database)
        self._directory = directory
        self._held = ExitStack()
        with self._held, directory.alone():
            # Who records the same at this moment is refused, or refuses us.
            if check is not None:
                check(self.catalog)
            self.entry = self._begin(name, tags, source)
            self._held = self._held.pop_all()
        self.indexer = ChunkIndexer(self.entry.id, self.entry.key)
        recording = directory.recording(self.entry.id)
        lag = Lag(recording, pace.behind, pace.has_room, pace.renew, pace.spare) if pace else None
        self._gatherer = FieldGatherer(recording)
        self.index = IndexWriter(self.indexer, database, lag=lag, gatherer=self._gatherer)
        self._held.callback(self.index.release)
        self.writer = RecordingWriter(
            recording,
            recording_metadata(self.entry),
            self.index.submit,
            settings,
            hurry=pace.hurry if pace else None,
            next_chunk_size=pace.next_chunk_size if pace else None,
            spare=pace.spare if pace else None,
            on_written=pace.on_written if pace else None,
        )

    def close(self, end: Mapping[str, Any]) -> DatabaseError | None:
        """Bring the recording to its end; `entry` is then complete.

        Args:
            end: What its last segment says of it: `status` and `losses`.

        Returns:
            Why the index is not complete, None when it is.
        """
        self.writer.close(json_metadata(END_METADATA, end))
        return self._finish()

    def give_up(
        self, end: Mapping[str, Any], lost: Sequence[Mapping[str, Any]]
    ) -> DatabaseError | None:
        """Bring the recording to its end where nothing more can be written.

        Args:
            end: As for `close`.
            lost: Rows of the loss ledger.

        Returns:
            Why the index is not complete, None when it is.

        Raises:
            DiskFullError: There is not even room for that.
        """
        self.writer.give_up(
            [json_metadata(LOSSES_METADATA, {"rows": lost}), json_metadata(END_METADATA, end)]
        )
        return self._finish()

    def _finish(self) -> DatabaseError | None:
        self.index.close()
        self.entry = build_entry(self._directory, self.indexer, self.entry.id, self.index.totals())
        failure = self.index.failure
        if failure is None:
            self._gatherer.close(self.entry)
            self.catalog = Catalog(self.index.database)
            try:
                self.catalog.put_losses(self.entry.id, self.entry.end.get("losses", []))
                self.catalog.put_schemas(self.writer.channels.values())
                self.catalog.put_recording(self.entry)
            except DatabaseError as error:
                failure = error
        self._gatherer.discard()
        self._held.close()
        return failure

    def leave(self) -> None:
        """Stop at once; what was flushed stays, and the next opening of the store seals it."""
        self.writer.abort()
        self.index.abandon()
        self._gatherer.discard()
        self._held.close()

    def forget(self) -> None:
        """Take the whole recording back."""
        self.writer.abort()
        self.index.abandon()
        self._gatherer.discard()
        # If the database is away too, the next opening finds an entry without files.
        with suppress(DatabaseError):
            collections = {collection_of(c.topic) for c in self.writer.channels.values()}
            self.catalog.remove_recording(self.entry.id, collections)
        self._directory.remove_recording(self.entry.id)
        self._held.close()

    def _begin(
        self, name: str, tags: Mapping[str, str], source: Mapping[str, Any]
    ) -> RecordingEntry:
        """The recording's directory, locked, and its first entry."""
        name = text(name)
        recording_id = self._directory.new_recording(name)
        try:
            if not self._held.enter_context(self._directory.writing(recording_id)):
                where = self._directory.recording(recording_id)
                raise StoreError(f"Another process is writing {where}.")
            entry = RecordingEntry(
                id=recording_id,
                key=new_key(r.key for r in self.catalog.recordings()),
                name=name,
                tags={text(key): text(value) for key, value in tags.items()},
                source=dict(source),
                created=time.time_ns(),
                status="open",
            )
            self.catalog.put_recording(entry)
        except BaseException:
            self._directory.remove_recording(recording_id)
            raise
        return entry


def text(name: str) -> str:
    """A name as text that MongoDB and JSON take: what is no UTF-8 in it as escapes."""
    return os.fsencode(name).decode("utf-8", "backslashreplace")
