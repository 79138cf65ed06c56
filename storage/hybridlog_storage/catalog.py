"""The catalog: a cache of what manifests say, and what reading their files has found out.

It may be deleted at any time. Of each recording it has the summary, made of a manifest and used
while that and the folder look the same, and the chunks that cannot be read; of each segment, by
its digest, what was found out by decoding. Chunks are read from the footers of segments.

Summaries of recordings, which say enough to choose among them.

A question first chooses among summaries, and then reads the entries of the chosen
recordings. The summaries of ten thousand recordings load within a tenth of a second.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple, TypeVar

from msgspec import Meta, Struct, field
from msgspec.json import Decoder, encode
from msgspec.structs import replace

from hybridlog_storage.cache import Cache
from hybridlog_storage.cells import Cells, drop, put
from hybridlog_storage.errors import SegmentError, StoreError
from hybridlog_storage.manifest import LOST, File, Manifest
from hybridlog_storage.manifests import RECORDINGS
from hybridlog_storage.messages import EXPIRED_IDS, Channel, Schema, schema_hash
from hybridlog_storage.segments.chunk_table import ChunkTable
from hybridlog_storage.segments.segment_file import listed_parts
from hybridlog_storage.segments.segment_format import sealed_name
from hybridlog_storage.segments.segment_reader import GoneLog, SegmentSummary, open_log
from hybridlog_storage.times import span_of

if TYPE_CHECKING:
    from hybridlog_storage.segments.walk import Flushed

MAX_INT: Final = 2**63 - 1
"""The greatest time and count, without the sign."""
Int = Annotated[int, Meta(ge=-MAX_INT, le=MAX_INT)]


class TopicType(NamedTuple):
    """A topic of a recording, and how its messages are encoded.

    `encoding` is empty if all messages of the topic are lost; `schema`, a hash, and `type`, its
    name, without one.
    """

    topic: str
    encoding: str
    schema: str
    type: str


class RecordingSummary(NamedTuple):
    """One recording in short; attributes without a description are as of `RecordingEntry`.

    Attributes:
        span: Log time `[first, last]`, ns, both inclusive; None without messages.
        extent: Log time `[begin, end)`, ns, with lost messages; `(0, 0)` without any.
        topics: Hash of its topics and their types; see `hash_of`.
        has_losses: Whether its loss ledger has a row.
        has_lost_segments: Whether stored messages of it are missing.
        expired: Number of messages whose payloads were deleted to make room.
        not_copied: Number of messages whose payloads were not copied yet.
        look: State of its directory and its manifest then.
        indexed_by: The id of the index that is known to be complete for it; empty if none is.
    """

    id: str
    name: str
    tags: dict[str, str]
    source: dict[str, Any]
    created: Int
    status: str
    span: tuple[Int, Int] | None
    extent: tuple[Int, Int]
    topics: str
    topic_count: Int
    messages: Int
    stored_bytes: Int
    segments: Int
    has_losses: bool
    has_lost_segments: bool
    expired: Int
    not_copied: Int
    notes: list[dict[str, Any]]
    look: str
    indexed_by: str = ""

    @property
    def key(self) -> str:
        """The random digits of the id; index documents refer to it."""
        return self.id[-16:]


def topics_to_json(topics: Iterable[TopicType]) -> str:
    """Topics and their types as text, in ASCII; equal for equal sets."""
    return json.dumps(sorted(set(topics)), separators=(",", ":"))


def hash_of(topics: str) -> str:
    """128 bits of BLAKE2b of the text of a set of topics, in hexadecimal digits."""
    return hashlib.blake2b(topics.encode(), digest_size=16).hexdigest()


WHOLE: Final = -1
"""Stands for all chunks of a segment whose summary cannot be read, or is another one."""
Damage = Mapping[tuple[int, int], str]
"""Why chunks of a recording cannot be read, by segment and number."""
_SUMMARY: Final = "summary"
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


class ChannelStats(Struct):
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
        for name in ("first", "first_stamp", "skew_min"):
            setattr(self, name, min(self._both(other, name), default=None))
        for name in ("last", "last_stamp", "skew_max"):
            setattr(self, name, max(self._both(other, name), default=None))

    def _both(self, other: ChannelStats, name: str) -> list[int]:
        return [value for one in (self, other) if (value := getattr(one, name)) is not None]


class ChannelEntry(Struct):
    """One channel of a recording."""

    id: Int
    topic: str
    message_encoding: str
    schema: str | None
    type: str
    metadata: dict[str, str]
    has_publish_time: bool = True
    stats: ChannelStats = field(default_factory=ChannelStats)
    is_indexed: bool = True
    """False if its messages get no documents in MongoDB."""

    def __repr__(self) -> str:
        return f"<Channel {self.topic} {self.type}; {self.stats.messages} messages>"


class RecordingEntry(Struct):
    """A recording at one moment: its manifest, and what is known of its files.

    Attributes:
        manifest: What it is, what users said of it, and its files.
        status: `open` (being recorded), `unfinished` (cut short by a crash, in a read-only
            store), `complete`, `recovered` (from a crash), `damaged` (the source or a part of
            the recording), or `unproven` (the manifest was lost).
        losses: Rows of the loss ledger, those of files that are lost included.
        channels: Its channels.
        stored_bytes: Size of its segments and of its files of rows.
        segments: Number of segments.
        chunks: Number of chunks.
        attachments: Number of attachments of its log.
        metadata_records: Number of metadata records of its log.
        spans: Number, first and last log time (ns) of each segment that has messages.
        logs: The line of the manifest of each segment that is there, by number.
        digests: Their digests, by number as text.
        files: Of those that are gone, the names of their first files of rows.
        is_decoded: Whether messages were decoded. Otherwise header stamps, and messages that
            do not fit their definition, are unknown.
        flushed: Content of segments that are not sealed, and of marks, by number, at one moment.
    """

    manifest: Manifest
    status: str
    losses: list[dict[str, Any]] = field(default_factory=list)
    channels: list[ChannelEntry] = field(default_factory=list)
    stored_bytes: Int = 0
    segments: Int = 0
    chunks: Int = 0
    attachments: Int = 0
    metadata_records: Int = 0
    spans: list[tuple[Int, Int, Int]] = field(default_factory=list)
    logs: dict[int, File] = field(default_factory=dict)
    digests: dict[str, str] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)
    is_decoded: bool = False
    flushed: dict[int, Flushed] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"<Recording {self.name}; {len(self.channels)} channels, {self.messages} messages>"

    @property
    def id(self) -> str:
        """Name of its directory, which never changes; everything refers to it."""
        return self.manifest.id

    @property
    def name(self) -> str:
        """What people call it; no other recording had this name when it got it."""
        return self.manifest.name

    @property
    def tags(self) -> dict[str, str]:
        """Tags given by the user."""
        return self.manifest.tags

    @property
    def created(self) -> int:
        """Time of recording, ns."""
        return self.manifest.created

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

    @property
    def topics(self) -> set[str]:
        """All topics: a question about one that has lost all stored messages must say so."""
        lost = {row["topic"] for row in self.losses if row["cause"] == LOST} - {None}
        return lost | {channel.topic for channel in self.channels}

    @property
    def lost_spans(self) -> list[tuple[int, int]]:
        """First and last log time (ns) of lost stored messages, for each row of the ledger."""
        lost = (row for row in self.losses if row["cause"] == LOST)
        return [(row["from"], row["to"]) for row in lost if row["from"] is not None]

    @property
    def extent(self) -> tuple[int, int]:
        """Log time `[begin, end)`, ns; empty at 0 without messages.

        Stored messages that are lost count, which preserves the meaning of relative times.
        """
        spans = [*self.lost_spans, *([] if self.span is None else [self.span])]
        return span_of(min(spans)[0], max(last for _, last in spans)) if spans else (0, 0)

    def spans_with(self, channels: Collection[int]) -> list[tuple[int, int, int]]:
        """The spans of segments that may have messages of some channels."""
        wanted = {channel % EXPIRED_IDS for channel in channels}
        return [
            span
            for span in self.spans
            if (log := self.logs.get(span[0])) is None or not wanted.isdisjoint(log.parts)
        ]


def channel_totals(table: ChunkTable) -> dict[int, ChannelStats]:
    """Statistics of the channels of a segment, before its messages are decoded."""
    rows = table.by_channel()[["channel", "messages", "payload_bytes", "first", "last"]].tolist()
    return {
        channel: ChannelStats(messages, payload_bytes, first=first, last=last)
        for channel, messages, payload_bytes, first, last in rows
    }


class Catalog:
    """The catalog of the store at a path, in some cells. Thread safe."""

    def __init__(self, store: Path, cells: Cells) -> None:
        self._store, self._cells = store, cells
        self._topics: dict[str, tuple[TopicType, ...]] = {}
        self._tables = Cache(_MAX_TABLES)

    def close(self) -> None:
        """Close the file."""
        self._tables.drop("table")
        self._cells.close()

    # Changes.

    def put(self, summaries: Collection[tuple[RecordingSummary, Collection[TopicType]]]) -> None:
        """Insert or replace summaries of recordings, with their topics."""
        topics = {one.topics: tuple(types) for one, types in summaries}
        self._topics.update(topics)
        cells = [put(_TOPICS, one, topics_to_json(types).encode()) for one, types in topics.items()]
        self._cells.write(cells + [put(_SUMMARY, one.id, encode(one[:-1])) for one, _ in summaries])

    def put_indexed(self, recordings: Collection[str], index: str) -> None:
        """Note that an index is complete for recordings, as long as they look the same."""
        known = self._cells.each(_INDEX, recordings)
        cells = [
            put(_INDEX, one.id, _body([index, one.look, _indexed(known.get(one.id))[2]]))
            for one in self.summaries(recordings)
            if one.indexed_by != index
        ]
        self._cells.write(cells)

    def put_damage(self, recording: str, damage: Damage) -> None:
        """Store the unreadable chunks of a recording."""
        rows = [(*place, reason) for place, reason in sorted(damage.items())]
        self._cells.write([put(_INDEX, recording, _body(["", "", rows]))])

    def put_decoded(
        self, recording: str, number: int, digest: str, decoded: Mapping[int, ChannelStats]
    ) -> None:
        """Store the results of decoding a segment."""
        rounded = {n: replace(one, skew_sum=float(one.skew_sum)) for n, one in decoded.items()}
        self._cells.write([put(_DECODED, recording, encode((number, digest, rounded)), number)])

    def put_schemas(self, schemas: Iterable[Schema]) -> None:
        """Store schemas."""
        heads = ((one, _body([one.name, one.encoding])) for one in schemas)
        self._cells.write(
            [
                put(_SCHEMA, schema_hash(one), b"%b\n%b" % (head, bytes(one.data)))
                for one, head in heads
            ]
        )

    def remove(self, recording: str) -> None:
        """Remove a recording."""
        self._tables.drop("table", recording)
        self._cells.write([drop(kind, recording) for kind in (_SUMMARY, _INDEX, _DECODED)])

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
            raise StoreError(f"The catalog of {self._store} has lost topics. Ask again.")
        return found

    def _set(self, digest: str) -> tuple[TopicType, ...] | None:
        found = self._topics.get(digest)
        if found is None:
            body = self._cells.read(_TOPICS, digest) or b""
            found = _read(_TOPICS_OF, body)
            if found is not None and hash_of(body.decode()) == digest:
                self._topics[digest] = found
        return self._topics.get(digest)

    def damaged(self, recordings: Collection[str]) -> dict[str, dict[tuple[int, int], str]]:
        """The unreadable chunks of those recordings, by id, that are known to have some."""
        known = self._cells.each(_INDEX, recordings)
        rows = {recording: _indexed(body)[2] for recording, body in known.items()}
        return {one: {(n, chunk): why for n, chunk, why in own} for one, own in rows.items() if own}

    def damage(self, recording: str) -> dict[tuple[int, int], str]:
        """The unreadable chunks of a recording."""
        return self.damaged([recording]).get(recording, {})

    def decoded(
        self, recording: str, digests: Mapping[int, str]
    ) -> dict[int, dict[int, ChannelStats]]:
        """Results of decoding those segments of a recording that have these digests, by number."""
        bodies = self._cells.of(_DECODED, recording) if digests else ()
        rows = (row for body in bodies if (row := _read(_DECODED_OF, body)) is not None)
        return {number: found for number, digest, found in rows if digests.get(number) == digest}

    def schemas(self, hashes: Iterable[str]) -> dict[str, Schema]:
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
        """The chunks of a segment, from its footer; `SegmentError` if that is another one."""
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
        with open_log(path, number) as reader:
            is_ours = not isinstance(reader, GoneLog) or digest == reader.digest()
            summary = reader.summary()
        channels = {one.id: (one.topic, one.schema) for one in entry.channels}
        if not is_ours or not is_of(summary, entry.id, entry.logs.get(number), channels, number):
            raise SegmentError(f"Segment {path} has changed since the store was opened.")
        return summary.table


def is_of(
    summary: SegmentSummary,
    recording: str,
    log: File | None,
    channels: Mapping[int, tuple[str, str | None]],
    number: int,
) -> bool:
    """True for a segment of a recording and number that is as its manifest lists it.

    `channels` are the topic and the hash of the schema by id, of the manifest; None of `log` for
    one that is not listed.
    """
    if (summary.recording.get("id"), summary.recording.get("segment")) != (recording, number):
        return False
    if log is None:
        return True
    has_parts = (summary.size, listed_parts(summary.table.as_stored())) == (log.bytes, log.parts)
    own = {n: (c.topic, _hash_of(c)) for n, c in summary.channels.items() if n in channels}
    return has_parts and all(channels[n] == one for n, one in own.items())


def _hash_of(channel: Channel) -> str | None:
    return None if channel.schema is None else schema_hash(channel.schema)


def _body(values: object) -> bytes:
    # In ASCII: the name of a file may not be UTF-8.
    return json.dumps(values, separators=(",", ":")).encode("ascii")


_SUMMARY_OF: Final = Decoder(RecordingSummary)
_TOPICS_OF: Final = Decoder(tuple[TopicType, ...])
_Indexed = tuple[str, str, list[tuple[Int, Int, str]]]
"""An index that is complete for a recording, its look then, and its unreadable chunks."""
_INDEX_OF: Final = Decoder(_Indexed)
_NAMES_OF: Final = Decoder(tuple[str, str])
_DECODED_OF: Final = Decoder(tuple[Int, str, dict[int, ChannelStats]])


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


def channel_entry(channel_id: int, channel: Channel) -> ChannelEntry:
    """The entry of a channel without messages."""
    return ChannelEntry(
        id=channel_id,
        topic=channel.topic,
        message_encoding=channel.message_encoding,
        schema=_hash_of(channel),
        type=channel.schema.name if channel.schema is not None else "",
        metadata=dict(channel.metadata),
        has_publish_time=channel.has_publish_time,
        is_indexed=channel.is_indexed,
    )
