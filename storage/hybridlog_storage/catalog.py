"""The catalog: what is known of all recordings of a store, without a look at their files.

It is derived from manifests and segments, and may be deleted at any time. It lists recordings
with summaries, and says more of those that are asked about: their channels, statistics and
losses, and what was found out by decoding. What it says of a recording also has the state of
the files that it was read from (sizes, times), and is used only while that is unchanged. Chunks
are read from the footers of segments.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Collection, Container, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

from msgspec import to_builtins
from msgspec.json import Decoder, encode

from hybridlog_storage.cache import Cache
from hybridlog_storage.cells import Cells, Statement, drop, put
from hybridlog_storage.disk import durability, files
from hybridlog_storage.errors import CatalogError, SegmentError
from hybridlog_storage.manifests import RECORDINGS
from hybridlog_storage.messages import EXPIRED_IDS, MARKS_CHANNEL, Channel, Schema, schema_hash
from hybridlog_storage.segments.chunk_table import ChunkTable
from hybridlog_storage.segments.gone_log import GoneLog, open_log
from hybridlog_storage.segments.segment_file import sealed_name
from hybridlog_storage.summary import (
    Int,
    RecordingSummary,
    TopicType,
    hash_of,
    topics_to_json,
)

if TYPE_CHECKING:
    from hybridlog_storage.segments.walk import Flushed
else:
    Flushed = Any  # in no file

CATALOG: Final = "catalog.sqlite"
"""Name of the file in the store's directory."""
_SUMMARY: Final = "summary"
_ENTRY: Final = "entry"
_INDEX: Final = "index"
_DECODED: Final = "decoded"
"""Kinds of the cells of a recording, whose key is its id; `_DECODED` has one a segment."""
_TOPICS: Final = "topics"
_SCHEMA: Final = "schema"
"""Kinds of the cells of sets of topics and of schemas, by hash; nothing removes them."""
_MAX_TABLES: Final = 64 << 20  # bytes of chunk tables in memory
_T = TypeVar("_T")
_COUNTS: Final = (
    "messages", "payload_bytes", "unreadable", "surplus", "stamped", "unset", "skew_sum",
)  # fmt: skip


@dataclass(slots=True)
class ChannelStats:
    """Statistics of the messages of one channel, in a chunk or in a recording.

    Times are nanoseconds; `first` and `last` are both inclusive; None without messages
    or, for stamps, without a header. Skew is log time minus header stamp, of stamps that were
    set: `unset` counts those of zero. `surplus` counts messages with bytes left over behind
    their last field.
    """

    messages: Int = 0
    payload_bytes: Int = 0
    unreadable: Int = 0
    surplus: Int = 0
    first: Int | None = None
    last: Int | None = None
    first_publish: Int | None = None
    last_publish: Int | None = None
    first_stamp: Int | None = None
    last_stamp: Int | None = None
    stamped: Int = 0
    unset: Int = 0
    skew_sum: float = 0.0
    skew_min: Int | None = None
    skew_max: Int | None = None

    @property
    def mean_skew(self) -> float | None:
        """Mean skew, ns; None if no stamp was set."""
        return self.skew_sum / (self.stamped - self.unset) if self.stamped > self.unset else None

    def add(self, other: ChannelStats) -> None:
        """Add the messages of another part of the channel."""
        for name in _COUNTS:
            setattr(self, name, getattr(self, name) + getattr(other, name))
        for name in ("first", "first_publish", "first_stamp", "skew_min"):
            setattr(self, name, _least(getattr(self, name), getattr(other, name)))
        for name in ("last", "last_publish", "last_stamp", "skew_max"):
            setattr(self, name, _greatest(getattr(self, name), getattr(other, name)))


@dataclass(slots=True, repr=False)
class ChannelEntry:
    """One channel of a recording."""

    id: Int
    topic: str
    message_encoding: str
    schema: str | None
    type: str
    metadata: dict[str, str]
    has_publish_time: bool
    reason: str | None
    """Reason why its fields are not indexed, None if they are."""
    stats: ChannelStats = field(default_factory=ChannelStats)
    is_indexed: bool = True
    """False if its messages get no documents in MongoDB."""

    def __repr__(self) -> str:
        return f"<Channel {self.topic} {self.type}; {self.stats.messages} messages>"

    @property
    def unindexed(self) -> str | None:
        """Reason why MongoDB has no fields of its messages, None if it has."""
        if self.id == MARKS_CHANNEL:
            return "marks that somebody set"
        return self.reason if self.is_indexed else "recorded with --no-index"


@dataclass(slots=True, repr=False)
class RecordingEntry:
    """One recording.

    Attributes:
        id: Name of its directory, which never changes; everything refers to it.
        name: What people call it; no other recording had this name when it got it.
        tags: Tags given by the user.
        source: The recorded log: path, kind, profile, bytes, fingerprint.
        created: Time of recording, ns.
        status: `open` (being recorded), `unfinished` (cut short by a crash, in a read-only
            store), `complete`, `recovered` (from a crash), `damaged` (the source or a part of
            the recording), or `unproven` (the manifest was lost).
        end: The state at its end: losses, damage.
        channels: Its channels.
        stored_bytes: Size of its segments and of its files of rows.
        segments: Number of segments.
        chunks: Number of chunks.
        attachments: Number of attachments of its log.
        metadata_records: Number of metadata records of its log.
        notes: Notes of users: `at` (ns) and `text`.
        marks: Marks that somebody set: `id`, `time` (ns), `text`, `tags`; those that last, `end`
            (ns).
        pins: What is never deleted to make room: `id`, `from`, `to`, `topics`, `reason`.
        spans: Number, first and last log time (ns) of each segment that has messages.
        held: Ids of the channels with messages in each sealed segment, by its number as text.
        digests: Digest of each valid segment as it was sealed, by its number as text.
        files: Of those that are gone, the names of their first files of rows.
        is_decoded: Whether messages were decoded. Otherwise header stamps, and messages that
        do not fit their definition, are unknown.
        rows: Name, topic and bytes of each file of rows.
        copies: Addresses of stores with copies that have more payloads.
        flushed: Content of segments that are not sealed, and of marks, by number, at one moment;
            the catalog's file does not have it.
    """

    id: str
    name: str
    tags: dict[str, str]
    source: dict[str, Any]
    created: Int
    status: str
    end: dict[str, Any] = field(default_factory=dict)
    channels: list[ChannelEntry] = field(default_factory=list)
    stored_bytes: Int = 0
    segments: Int = 0
    chunks: Int = 0
    attachments: Int = 0
    metadata_records: Int = 0
    notes: list[dict[str, Any]] = field(default_factory=list)
    marks: list[dict[str, Any]] = field(default_factory=list)
    pins: list[dict[str, Any]] = field(default_factory=list)
    spans: list[tuple[Int, Int, Int]] = field(default_factory=list)
    held: dict[str, list[Int]] = field(default_factory=dict)
    digests: dict[str, str] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)
    is_decoded: bool = False
    rows: list[tuple[str, str, Int]] = field(default_factory=list)
    copies: list[str] = field(default_factory=list)
    flushed: dict[int, Flushed] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"<Recording {self.name}; {len(self.channels)} channels, {self.messages} messages>"

    @property
    def key(self) -> str:
        """The random digits of the id, 16; index documents refer to it."""
        return self.id[-16:]

    @property
    def messages(self) -> int:
        """Number of messages in all channels."""
        return sum(c.stats.messages for c in self.channels)

    @property
    def documents(self) -> int:
        """Number of messages that have a document in a complete index."""
        return sum(c.stats.messages for c in self.channels if c.is_indexed)

    def messages_by_topic(self) -> Counter[str]:
        """Number of messages of each topic."""
        found: Counter[str] = Counter()
        for channel in self.channels:
            found[channel.topic] += channel.stats.messages
        return found

    @property
    def span(self) -> tuple[int, int] | None:
        """Log time `[first, last]`, ns, both inclusive; None without messages."""
        firsts = [c.stats.first for c in self.channels if c.stats.first is not None]
        lasts = [c.stats.last for c in self.channels if c.stats.last is not None]
        return (min(firsts), max(lasts)) if firsts else None

    def spans_with(self, channels: Collection[int]) -> list[tuple[int, int, int]]:
        """The spans of segments that may have messages of some channels."""
        wanted = {*channels}
        return [
            span
            for span in self.spans
            if (held := self.held.get(str(span[0]))) is None or not wanted.isdisjoint(held)
        ]


def channel_totals(
    table: ChunkTable, decoded: Mapping[int, ChannelStats] | None, silent: Container[int] = ()
) -> dict[int, ChannelStats]:
    """Statistics of the channels of a segment.

    `decoded` has the results of decoding, None before messages are decoded; `silent` has the ids of
    channels without publish times.
    """
    names = ("channel", "messages", "payload_bytes", "first", "last")
    rows = table.by_channel()[[*names, "first_publish", "last_publish"]].tolist()
    found: dict[int, ChannelStats] = {}
    for channel, messages, payload_bytes, first, last, *published in rows:
        stats = found[channel] = ChannelStats(
            messages=messages, payload_bytes=payload_bytes, first=first, last=last
        )
        if channel not in silent:
            stats.first_publish, stats.last_publish = published
        if decoded is not None and channel % EXPIRED_IDS in decoded:
            stats.add(decoded[channel % EXPIRED_IDS])
    return found


@dataclass(frozen=True, slots=True)
class Described:
    """A recording, as read from its files; used while `files`, their state, is unchanged."""

    entry: RecordingEntry
    summary: RecordingSummary
    topics: Collection[TopicType]
    files: str
    channels: Mapping[int, Channel]


class Catalog:
    """The catalog of a store; what is of another store is removed. Thread safe.

    `in_memory` leaves the file as it is, for a store that this user cannot write; `cells` are given
    if they lie elsewhere. `has_changed` says that this process has changed an ended recording.
    `recordings_file` lists these for other readers; it is removed when they change.
    """

    def __init__(
        self,
        store: Path,
        store_id: str,
        *,
        in_memory: bool = False,
        cells: Cells | None = None,
    ) -> None:
        self.is_in_memory = in_memory or cells is not None
        self.has_changed = False
        self._store = store
        self.recordings_file = store / "tables/recordings.parquet"
        self._cells = cells or Cells(store / CATALOG, store_id, writes=not in_memory)
        self._topics: dict[str, tuple[TopicType, ...]] = {}
        self._tables = Cache(_MAX_TABLES)

    def close(self) -> None:
        """Close the file."""
        self._tables.drop("table")
        self._cells.close()

    # Changes.

    def _remove_recordings_file(self) -> None:
        """Remove the list of ended recordings, which is wrong now."""
        if not self.is_in_memory:
            removing = durability.explained(self.recordings_file, "removing")
            with removing, suppress(FileNotFoundError):
                files.unlink(self.recordings_file)

    def put(self, described: Described) -> None:
        """Insert or replace a recording."""
        entry, summary = described.entry, described.summary
        if entry.status != "open":
            self.has_changed = True
            self._remove_recordings_file()
        self._tables.drop("table", entry.id)
        self._topics[summary.topics] = tuple(described.topics)
        plain = to_builtins(replace(entry, flushed={}))
        schemas = {c.schema for c in described.channels.values() if c.schema is not None}
        known = {schema_hash(schema): schema for schema in schemas}

        def statements() -> Iterator[Statement]:
            for digest, schema in known.items():
                if self._cells.read(_SCHEMA, digest) is None:
                    head = _body([schema.name, schema.encoding])
                    yield put(_SCHEMA, digest, head + b"\n" + bytes(schema.data))
            yield put(_TOPICS, summary.topics, topics_to_json(described.topics).encode())
            yield put(_ENTRY, entry.id, _body([described.files, plain]))
            yield put(_SUMMARY, entry.id, _summary_body(summary))
            index, _, damage = self._index(entry.id)
            if index:  # until it is compared with the index
                yield put(_INDEX, entry.id, _body(["", "", damage]))

        self._cells.write(statements)

    def put_summaries(
        self,
        summaries: Collection[RecordingSummary],
        topics: Mapping[str, Collection[TopicType]],
        *,
        is_change: bool,
    ) -> None:
        """Note summaries that manifests have made, at once.

        `topics` are by hash; `is_change` says that a summary differs, in more than its look, from
        what was known.
        """
        if is_change:
            self._remove_recordings_file()
        self._topics.update({digest: tuple(types) for digest, types in topics.items()})

        def statements() -> Iterator[Statement]:
            for digest, types in topics.items():
                yield put(_TOPICS, digest, topics_to_json(types).encode())
            for one in summaries:
                yield put(_SUMMARY, one.id, _summary_body(one))

        self._cells.write(statements)

    def put_indexed(self, recordings: Collection[str], index: str) -> None:
        """Note that an index is complete for recordings, as long as they look the same."""

        def statements() -> Iterator[Statement]:
            for one in self.summaries(recordings):
                if one.indexed_by != index:
                    yield put(_INDEX, one.id, _body([index, one.look, self._index(one.id)[2]]))

        self._cells.write(statements)

    def put_damage(self, recording: str, damage: Mapping[tuple[int, int], str]) -> None:
        """Store the unreadable chunks of a recording: reason by segment and number."""
        rows = [(*place, reason) for place, reason in sorted(damage.items())]
        self._cells.write(lambda: [put(_INDEX, recording, _body(["", "", rows]))])

    def put_decoded(
        self, recording: str, number: int, digest: str, decoded: Mapping[int, ChannelStats]
    ) -> None:
        """Store the results of decoding a segment."""
        rounded = {n: replace(one, skew_sum=float(one.skew_sum)) for n, one in decoded.items()}
        cell = put(_DECODED, recording, encode((digest, rounded)), number)
        self._cells.write(lambda: [cell])

    def remove(self, recording: str) -> None:
        """Remove a recording."""
        self.has_changed = True
        self._remove_recordings_file()
        self._tables.drop("table", recording)
        kinds = (_SUMMARY, _ENTRY, _INDEX, _DECODED)
        self._cells.write(lambda: [drop(kind, recording) for kind in kinds])

    # Answers.

    def summaries(self, recordings: Collection[str] | None = None) -> list[RecordingSummary]:
        """Summaries of recordings by id, None for all; unordered, without damaged ones."""
        indexed = self._cells.each(_INDEX, recordings)
        found = []
        for recording, body in self._cells.each(_SUMMARY, recordings).items():
            summary = _read(_SUMMARY_OF, body)
            if summary is None or summary.id != recording or self._set(summary.topics) is None:
                continue
            if recording in indexed:
                index, look, _ = _indexed(indexed[recording])
                if look == summary.look:
                    summary = summary._replace(indexed_by=index)
            found.append(summary)
        return found

    def topics(self, digest: str) -> tuple[TopicType, ...]:
        """A set of topics and their types, by its hash, which a summary has."""
        found = self._set(digest)
        if found is None:
            raise CatalogError(f"The catalog {self._store / CATALOG} has lost topics. Ask again.")
        return found

    def _set(self, digest: str) -> tuple[TopicType, ...] | None:
        found = self._topics.get(digest)
        if found is None:
            body = self._cells.read(_TOPICS, digest) or b""
            found = _read(_TOPICS_OF, body)
            if found is not None and hash_of(body.decode()) == digest:
                self._topics[digest] = found
        return self._topics.get(digest)

    def recording(self, recording: str) -> tuple[str, RecordingEntry] | None:
        """State of the files and entry of a recording; None if it is missing or damaged."""
        found = _read(_ENTRY_OF, self._cells.read(_ENTRY, recording))
        return found if found is not None and found[1].id == recording else None

    def _index(self, recording: str) -> _Indexed:
        return _indexed(self._cells.read(_INDEX, recording))

    def damaged(self, recordings: Collection[str]) -> set[str]:
        """Those of some recordings, by id, that are known to have unreadable chunks."""
        known = self._cells.each(_INDEX, recordings)
        return {recording for recording, body in known.items() if _indexed(body)[2]}

    def damage(self, recording: str) -> dict[tuple[int, int], str]:
        """The unreadable chunks of a recording: reason by segment and number."""
        return {(segment, chunk): reason for segment, chunk, reason in self._index(recording)[2]}

    def decoded(self, entry: RecordingEntry, number: int) -> dict[int, ChannelStats] | None:
        """Results of decoding a segment; None before its messages are decoded."""
        found = _read(_DECODED_OF, self._cells.read(_DECODED, entry.id, number))
        is_ours = found is not None and found[0] == entry.digests.get(str(number))
        return found[1] if found is not None and is_ours else None

    # Schemas.

    def schemas(self, hashes: Collection[str]) -> dict[str, Schema]:
        """Schemas by hash, without missing or damaged ones."""
        found: dict[str, Schema] = {}
        for digest in hashes:
            head, _, text = (self._cells.read(_SCHEMA, digest) or b"").partition(b"\n")
            names = _read(_NAMES_OF, head)
            if names is not None and schema_hash(schema := Schema(*names, text)) == digest:
                found[digest] = schema
        return found

    # Chunks.

    def table(self, entry: RecordingEntry, number: int) -> ChunkTable:
        """The chunks of a segment, from its footer."""
        if number in entry.flushed:
            return entry.flushed[number].table
        digest = entry.digests.get(str(number), "")
        return self._tables.made(
            "table",
            entry.id,
            number,
            digest + file_of(entry, number),
            make=lambda: self._read_table(entry, number, digest),
            size_of=lambda table: int(table.chunks.nbytes + table.parts.nbytes),
        )

    def _read_table(self, entry: RecordingEntry, number: int, digest: str) -> ChunkTable:
        path = self._store / RECORDINGS / entry.id / file_of(entry, number)
        try:
            with open_log(path, number) as reader:
                is_ours = not isinstance(reader, GoneLog) or digest == reader.digest()
                summary = reader.summary()
        except SegmentError as error:
            raise CatalogError(str(error)) from error
        said = summary.recording.get("id"), summary.recording.get("segment")
        is_ours &= said == (entry.id, number)
        if not is_ours or {*spans_of(number, summary.table)} - {*entry.spans}:
            raise CatalogError(f"Segment {path} has changed since the store was opened.")
        return summary.table


def _summary_body(summary: RecordingSummary) -> bytes:
    return encode(summary[:-1])


def _body(values: object) -> bytes:
    # In ASCII: the name of a file may not be UTF-8.
    return json.dumps(values, separators=(",", ":")).encode("ascii")


_SUMMARY_OF: Final = Decoder(RecordingSummary)
_TOPICS_OF: Final = Decoder(tuple[TopicType, ...])
_ENTRY_OF: Final = Decoder(tuple[str, RecordingEntry])
_Indexed = tuple[str, str, list[tuple[Int, Int, str]]]
"""An index that is complete for a recording, its look then, and its unreadable chunks."""
_INDEX_OF: Final = Decoder(_Indexed)
_DECODED_OF: Final = Decoder(tuple[str, dict[int, ChannelStats]])
_NAMES_OF: Final = Decoder(tuple[str, str])


def _read(decoder: Decoder[_T], body: bytes | None) -> _T | None:
    """The value of a cell; None if it is of another kind."""
    with suppress(ValueError, RecursionError):
        return decoder.decode(body or b"")
    return None


def _indexed(body: bytes | None) -> _Indexed:
    """The state of the index of a recording, and its unreadable chunks.

    Both are in one cell: without the list of chunks no index counts as complete.
    """
    return _read(_INDEX_OF, body) or ("", "", [])


def file_of(entry: RecordingEntry, number: int) -> str:
    """Name of the file of a sealed segment; of one that is gone, of its first file of rows."""
    return entry.files.get(str(number)) or sealed_name(number)


def spans_of(number: int, table: ChunkTable) -> list[tuple[int, int, int]]:
    """Number of a segment, first and last log time of its messages, ns; none without any."""
    if not len(table.parts):
        return []
    return [(number, int(table.parts["first"].min()), int(table.parts["last"].max()))]


def channel_entry(channel_id: int, channel: Channel, reason: str | None) -> ChannelEntry:
    """The catalog entry of a channel without messages."""
    return ChannelEntry(
        id=channel_id,
        topic=channel.topic,
        message_encoding=channel.message_encoding,
        schema=schema_hash(channel.schema) if channel.schema is not None else None,
        type=channel.schema.name if channel.schema is not None else "",
        metadata=dict(channel.metadata),
        has_publish_time=channel.has_publish_time,
        reason=reason,
        is_indexed=channel.is_indexed,
    )


def _least(a: int | None, b: int | None) -> int | None:
    return b if a is None else a if b is None else min(a, b)


def _greatest(a: int | None, b: int | None) -> int | None:
    return b if a is None else a if b is None else max(a, b)
