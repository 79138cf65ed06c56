"""The catalog: which recordings, segments, chunks and schemas exist.

Everything in it can be read again from the segments; `reindex` does. A chunk's entry is
written after its index documents, so a chunk that has an entry is indexed, and what a
crash left out is found by comparing entries with the segment's own list of chunks.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Collection, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Final, Self, cast

from hybridlog_storage.database import Database
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segment_reader import ChunkPlace

RECORDINGS: Final = "hybridlog.recordings"
SCHEMAS: Final = "hybridlog.schemas"
CHUNKS: Final = "hybridlog.chunks"
LOSSES: Final = "hybridlog.losses"
_BRIEF: Final = {
    **dict.fromkeys(("rec", "seg", "len", "trailer", "first", "last"), 1),
    **{f"ch.{name}": 1 for name in ("c", "messages", "first", "last")},
}
_CHUNK_ENTRIES = 500  # decoded at once; as dictionaries they take some kilobytes each


@dataclass(slots=True)
class ChannelStats:
    """What is known of the messages of one channel, in a chunk or in a recording.

    Times are nanoseconds; `first` and `last` are both inclusive; None without messages
    or, for stamps, without a header. Skew is log time minus header stamp.
    """

    messages: int = 0
    payload_bytes: int = 0
    unreadable: int = 0
    first: int | None = None
    last: int | None = None
    first_publish: int | None = None
    last_publish: int | None = None
    first_stamp: int | None = None
    last_stamp: int | None = None
    stamped: int = 0
    skew_sum: float = 0.0
    skew_min: int | None = None
    skew_max: int | None = None
    longest: int = 0
    """Most log time that one chunk's messages of the channel span."""

    def add(self, other: ChannelStats) -> None:
        """Take in the messages of another part of the channel."""
        for name in ("messages", "payload_bytes", "unreadable", "stamped", "skew_sum"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        for name in ("first", "first_publish", "first_stamp", "skew_min"):
            setattr(self, name, _least(getattr(self, name), getattr(other, name)))
        for name in ("last", "last_publish", "last_stamp", "skew_max", "longest"):
            setattr(self, name, _greatest(getattr(self, name), getattr(other, name)))


_STATS = tuple(of.name for of in fields(ChannelStats))


def _as_dict(stats: ChannelStats) -> dict[str, int | float | None]:
    """By name, without the copies that `asdict` makes of each value."""
    return {name: getattr(stats, name) for name in _STATS}


@dataclass(slots=True)
class ChannelEntry:
    """One channel of a recording."""

    id: int
    topic: str
    message_encoding: str
    schema: str | None
    type: str
    metadata: dict[str, str]
    has_publish_time: bool
    reason: str | None
    """Why its fields are not in the index, None when they are."""
    stats: ChannelStats = field(default_factory=ChannelStats)


@dataclass(slots=True)
class RecordingEntry:
    """One recording.

    Attributes:
        id: Name of its directory, unique in the store.
        key: Number of the recording, 32 bits, unique in the store.
        name: As the user calls it.
        tags: As the user gave them.
        source: Where it came from: path, kind, profile, bytes, fingerprint.
        created: When it was recorded, ns.
        status: `open`, `complete`, `damaged` (the source was), `recovered` (from a crash).
        end: How it ended: losses, damage.
        channels: Its channels.
        stored_bytes: Size of its segments.
        segments: Number of segments.
        chunks: Number of chunks.
    """

    id: str
    key: int
    name: str
    tags: dict[str, str]
    source: dict[str, Any]
    created: int
    status: str
    end: dict[str, Any] = field(default_factory=dict)
    channels: list[ChannelEntry] = field(default_factory=list)
    stored_bytes: int = 0
    segments: int = 0
    chunks: int = 0

    @property
    def messages(self) -> int:
        """Messages in all channels."""
        return sum(c.stats.messages for c in self.channels)

    def stats_of(self, topic: str) -> list[ChannelStats]:
        """What is known of each of a topic's channels."""
        return [c.stats for c in self.channels if c.topic == topic]

    def messages_of(self, topic: str) -> int:
        """Messages of a topic."""
        return sum(stats.messages for stats in self.stats_of(topic))

    @property
    def span(self) -> tuple[int, int] | None:
        """Log time `[first, last]`, ns, both inclusive; None without messages."""
        firsts = [c.stats.first for c in self.channels if c.stats.first is not None]
        lasts = [c.stats.last for c in self.channels if c.stats.last is not None]
        return (min(firsts), max(lasts)) if firsts else None

    def to_document(self) -> dict[str, Any]:
        """As it stands in MongoDB."""
        document = asdict(self)
        document["_id"] = document.pop("id")
        return document

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> RecordingEntry:
        """From MongoDB."""
        values = dict(document)
        values["id"] = values.pop("_id")
        values["channels"] = [
            ChannelEntry(**{**c, "stats": ChannelStats(**c["stats"])}) for c in values["channels"]
        ]
        return cls(**values)


@dataclass(frozen=True, slots=True)
class ChunkEntry:
    """One chunk: where it lies and what is in it, by channel id."""

    recording: str
    segment: int
    offset: int
    length: int
    trailer: int
    first: int
    last: int
    stats: dict[int, ChannelStats]

    @property
    def place(self) -> ChunkPlace:
        """Where it lies in its segment, as the segment's reader wants to know it."""
        return ChunkPlace(
            self.offset, self.length, self.trailer, self.first, self.last, tuple(self.stats)
        )

    @property
    def messages(self) -> int:
        """Number of its messages."""
        return sum(stats.messages for stats in self.stats.values())

    def span(self, channels: Container[int]) -> tuple[int, int] | None:
        """First and last log time of some channels in it, None when it has none of them."""
        stats = [s for c, s in self.stats.items() if c in channels]
        firsts = [s.first for s in stats if s.first is not None]
        lasts = [s.last for s in stats if s.last is not None]
        return (min(firsts), max(lasts)) if firsts and lasts else None


class ChannelTotals:
    """Statistics of channels, summed up chunk by chunk; the order makes no difference."""

    def __init__(self) -> None:
        self._stats: dict[int, ChannelStats] = {}
        # Of floats the order would: these are exact, since a skew is a number of nanoseconds.
        self._skews: Counter[int] = Counter()

    @classmethod
    def of(cls, chunks: Iterable[ChunkEntry]) -> Self:
        """The totals of some chunks."""
        totals = cls()
        for chunk in chunks:
            totals.add(chunk)
        return totals

    def add(self, chunk: ChunkEntry) -> None:
        """Take in a chunk."""
        for channel, stats in chunk.stats.items():
            self._stats.setdefault(channel, ChannelStats()).add(stats)
            self._skews[channel] += int(stats.skew_sum)

    def stats(self, channel: int) -> ChannelStats:
        """What is known of a channel: nothing, if no chunk had messages of it."""
        return replace(
            self._stats.get(channel, ChannelStats()), skew_sum=float(self._skews[channel])
        )


class Catalog:
    """The catalog collections of a database."""

    def __init__(self, database: Database) -> None:
        self._db = database

    def prepare(self) -> None:
        """Make the indexes that questions to the catalog need."""
        self._db.create_index(CHUNKS, [("rec", 1), ("ch.c", 1), ("ch.first", 1)])

    def put_recording(self, entry: RecordingEntry) -> None:
        """Write or replace a recording."""
        self._db.replace(RECORDINGS, {"_id": entry.id}, entry.to_document())

    def recordings(self) -> list[RecordingEntry]:
        """All recordings, oldest log time first, empty ones last."""
        found = [RecordingEntry.from_document(d) for d in self._db.find(RECORDINGS, {})]
        return sorted(found, key=lambda r: (r.span is None, r.span or (0, 0), r.id))

    def put_schemas(self, channels: Iterable[Channel]) -> None:
        """Keep the schemas of channels, each under its hash."""
        self._db.replace_all(
            SCHEMAS,
            [
                {"_id": schema_hash(s), "name": s.name, "encoding": s.encoding, "data": s.data}
                for s in {channel.schema for channel in channels}
                if s is not None
            ],
        )

    def schemas(self, hashes: Collection[str]) -> dict[str, Schema]:
        """Schemas by hash."""
        return {
            d["_id"]: Schema(d["name"], d["encoding"], bytes(d["data"]))
            for d in self._db.find(SCHEMAS, {"_id": {"$in": list(hashes)}})
        }

    def put_chunks(self, chunks: Sequence[ChunkEntry]) -> None:
        """Note that chunks are in their segment and their messages are in the index."""
        self._db.replace_all(
            CHUNKS,
            [
                {
                    "_id": {"rec": chunk.recording, "seg": chunk.segment, "off": chunk.offset},
                    "rec": chunk.recording,
                    "seg": chunk.segment,
                    "len": chunk.length,
                    "trailer": chunk.trailer,
                    "first": chunk.first,
                    "last": chunk.last,
                    "ch": [{"c": c, **_as_dict(stats)} for c, stats in sorted(chunk.stats.items())],
                }
                for chunk in chunks
            ],
        )

    def chunks(
        self,
        recording: str,
        channels: Sequence[int] | None = None,
        bounds: tuple[int, int] | None = None,
        clock: str = "log",
        longest: int | None = None,
        *,
        brief: bool = False,
    ) -> list[ChunkEntry]:
        """Chunks of a recording that may hold messages of some channels in a time range.

        Args:
            recording: Its id.
            channels: Channel ids, None for all.
            bounds: `[begin, end)`, ns, None for all times.
            clock: `log`, `publish` or `header`: which time `bounds` is about.
            longest: Most log time that a chunk spans, ns, if known: no chunk that begins
                earlier than that before `bounds` needs to be looked at.
            brief: Of each channel only how many messages there are, and their first and
                last log time.
        """
        of_channel: dict[str, Any] = {}
        if channels is not None:
            of_channel["c"] = {"$in": list(channels)}
        if bounds is not None:
            suffix = {"log": "", "publish": "_publish", "header": "_stamp"}[clock]
            of_channel[f"first{suffix}"] = {"$lt": bounds[1]}
            if longest is not None and clock == "log":
                of_channel["first"]["$gte"] = max(bounds[0] - longest, 0)
            of_channel[f"last{suffix}"] = {"$gte": bounds[0]}
        query = {"ch": {"$elemMatch": of_channel}} if of_channel else {}
        return list(self._chunks({"rec": recording, **query}, brief=brief))

    def every_chunk(self, recording: str) -> Iterator[ChunkEntry]:
        """All chunks of a recording, one by one: of a long one too many to hold."""
        return self._chunks({"rec": recording})

    def _chunks(self, query: Mapping[str, Any], *, brief: bool = False) -> Iterator[ChunkEntry]:
        found = self._db.find(CHUNKS, query, _BRIEF if brief else None, batch_size=_CHUNK_ENTRIES)
        return map(_chunk_entry, found)

    def remove_recording(self, recording: str, collections: Iterable[str]) -> None:
        """Remove every trace of a recording from the database."""
        for collection in collections:
            self._db.delete(collection, {"_meta.rec": recording})
        self._db.delete(CHUNKS, {"rec": recording})
        self._db.delete(LOSSES, {"rec": recording})
        self._db.delete(RECORDINGS, {"_id": recording})

    def put_losses(self, recording: str, losses: Sequence[Mapping[str, object]]) -> None:
        """Replace the loss ledger of a recording."""
        self._db.delete(LOSSES, {"rec": recording})
        for number, loss in enumerate(losses):
            key = {"rec": recording, "n": number}
            self._db.replace(
                LOSSES, {"_id": key}, {"_id": key, "rec": recording, **dict(sorted(loss.items()))}
            )


def schema_hash(schema: Schema) -> str:
    """SHA-256 of name, encoding and definition, as hex digits."""
    digest = hashlib.sha256()
    for part in (schema.name.encode(), schema.encoding.encode(), bytes(schema.data)):
        digest.update(len(part).to_bytes(8, "little") + part)
    return digest.hexdigest()


def channel_entry(channel_id: int, channel: Channel, reason: str | None) -> ChannelEntry:
    """The catalog entry of a channel, without messages yet."""
    return ChannelEntry(
        id=channel_id,
        topic=channel.topic,
        message_encoding=channel.message_encoding,
        schema=schema_hash(channel.schema) if channel.schema is not None else None,
        type=channel.schema.name if channel.schema is not None else "",
        metadata=dict(channel.metadata),
        has_publish_time=channel.has_publish_time,
        reason=reason,
    )


def _chunk_entry(document: Mapping[str, Any]) -> ChunkEntry:
    stats = {}
    for item in document["ch"]:
        values = dict(item)
        channel = cast(int, values.pop("c"))
        stats[channel] = ChannelStats(**values)
    return ChunkEntry(
        document["rec"],
        document["seg"],
        document["_id"]["off"],
        document["len"],
        document["trailer"],
        document["first"],
        document["last"],
        stats,
    )


def _least(a: int | None, b: int | None) -> int | None:
    return b if a is None else a if b is None else min(a, b)


def _greatest(a: int | None, b: int | None) -> int | None:
    return b if a is None else a if b is None else max(a, b)
