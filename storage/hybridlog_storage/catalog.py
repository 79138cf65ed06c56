"""The catalog: what is known of all recordings of a store, without a look at their files.

It is derived from journals and segments, and may be deleted at any time. It lists recordings
with summaries, and says more of those that are asked about: their channels, statistics and
losses, and what was found out by decoding. It comes in parts, see `catalog_parts`, so a change
writes little. What it says of a recording also has the state of the files that it was read
from (sizes, times), and is used only while that is unchanged. Chunks are read from the footers
of segments.
"""

from __future__ import annotations

import hashlib
import json
import math
import stat
from base64 import b64decode, b64encode
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Container, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from threading import RLock
from typing import TYPE_CHECKING, Any, Final, TypeVar
from zlib import compress, decompressobj
from zlib import error as ZlibError  # noqa: N812

import numpy as np

from hybridlog_storage.cache import Cache
from hybridlog_storage.catalog_parts import (
    BOUNDS,
    DAMAGE,
    ENTRY,
    MAX_PART_BYTES,
    STAMPS,
    SUMMARY,
    TOPICS,
    DiskFolder,
    MemoryFolder,
    PartContent,
    Version,
    bounds_in,
    is_of_another,
    number_of,
    part_name,
    texts_in,
)
from hybridlog_storage.disk import durability, files
from hybridlog_storage.errors import (
    CatalogError,
    ResourceError,
    SegmentError,
    StoreError,
    exhausted,
)
from hybridlog_storage.lazy import RowType
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.ordering import run_starts
from hybridlog_storage.segments.chunk_table import ChunkTable
from hybridlog_storage.segments.segment_file import sealed_name
from hybridlog_storage.segments.segment_reader import ChunkPlace, SegmentReader
from hybridlog_storage.summary import (
    MAX_INT,
    RecordingSummary,
    TopicType,
    hash_of,
    topics_from_json,
    topics_to_json,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog_storage.segments.open_segment import Flushed

CATALOG: Final = "catalog"
"""Name of the folder in the store's directory."""
_SCHEMA: Final = "schema-"
"""Prefix of the files of schemas, by hash."""
_RECORDINGS: Final = "recordings"
_RECORDINGS_FILE: Final = Path("tables/recordings.parquet")
_TOPICS = RecordingSummary._fields.index("topics")
_BUSY_S: Final = 1.0
_MAX_TABLES: Final = 64 << 20  # bytes of chunk tables in memory
_MAX_BOUNDED_BYTES: Final = 56 << 10  # of a part from which recordings keep bounds of one kind
_BOUND_BYTES: Final = 128  # of a line with bounds, about
_MAX_BOUNDED_PARTS: Final = 256  # parts that are replaced at the end for the sake of bounds
_MAX_NOTED: Final = 1 << 17  # bounds that wait for the end
Ends = tuple[float | None, float | None]
"""The least and the greatest of some numbers; None twice without any."""
_STAMPS = RowType(
    ("unreadable", "<u4"),
    ("surplus", "<u4"),
    ("stamped", "<u4"),
    ("unset", "<u4"),
    ("first_stamp", "<i8"),
    ("last_stamp", "<i8"),
    ("skew_sum", "<f8"),
    ("skew_min", "<i8"),
    ("skew_max", "<i8"),
)
"""Results of decoding; one row for each row of `ChunkTable.parts`."""


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

    messages: int = 0
    payload_bytes: int = 0
    unreadable: int = 0
    surplus: int = 0
    first: int | None = None
    last: int | None = None
    first_publish: int | None = None
    last_publish: int | None = None
    first_stamp: int | None = None
    last_stamp: int | None = None
    stamped: int = 0
    unset: int = 0
    skew_sum: float = 0.0
    skew_min: int | None = None
    skew_max: int | None = None
    longest: int = 0
    """Longest span of log time of the channel's messages in one chunk."""

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
        for name in ("last", "last_publish", "last_stamp", "skew_max", "longest"):
            setattr(self, name, _greatest(getattr(self, name), getattr(other, name)))


def _values(item: ChannelEntry | ChannelStats) -> dict[str, Any]:
    """The fields of an entry by name."""
    return {name: getattr(item, name) for name in item.__slots__}


@dataclass(slots=True, repr=False)
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
    """Reason why its fields are not indexed, None if they are."""
    stats: ChannelStats = field(default_factory=ChannelStats)
    is_indexed: bool = True
    """False if its messages get no documents in MongoDB."""

    def __repr__(self) -> str:
        return f"<Channel {self.topic} {self.type}; {self.stats.messages} messages>"

    @property
    def unindexed(self) -> str | None:
        """Reason why MongoDB has no fields of its messages, None if it has."""
        return self.reason if self.is_indexed else "recorded with --no-index"


@dataclass(slots=True, repr=False)
class RecordingEntry:
    """One recording.

    Attributes:
        id: 32 random hexadecimal digits; everything refers to it.
        label: Name of its directory; may change at any time.
        name: Name given by the user.
        tags: Tags given by the user.
        source: The recorded log: path, kind, profile, bytes, fingerprint.
        created: Time of recording, ns.
        status: `open` (being recorded), `unfinished` (cut short by a crash, in a read-only
            store), `complete`, `recovered` (from a crash), `damaged` (the source or a part of
            the recording), or `unproven` (the journal was lost).
        end: The state at its end: losses, damage.
        channels: Its channels.
        stored_bytes: Size of its segments and of the fields of its expired messages.
        segments: Number of segments.
        chunks: Number of chunks.
        attachments: Number of attachments of its log.
        metadata_records: Number of metadata records of its log.
        notes: Notes of users: `at` (ns) and `text`.
        marks: Marks set after it ended: `time` (ns), `text`, `tags`; those that last, `end` (ns).
        pins: What is never deleted to make room: `id`, `from`, `to`, `topics`, `reason`.
        spans: Number, first and last log time (ns) of each segment that has messages.
        digests: Digest of each valid segment, by its number as text.
        stored: Digest of the files of those with expired chunks.
        is_decoded: Whether messages were decoded. Otherwise header stamps, and messages that
        do not fit their definition, are unknown.
        payloads: Files with fields of expired messages: `file`, `bytes`, `digest`, `topic`,
            `messages`.
        flushed: Content of segments that are not sealed, by number, at one moment; the
            catalog's file does not have it.
    """

    id: str
    label: str
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
    attachments: int = 0
    metadata_records: int = 0
    notes: list[dict[str, Any]] = field(default_factory=list)
    marks: list[dict[str, Any]] = field(default_factory=list)
    pins: list[dict[str, Any]] = field(default_factory=list)
    spans: list[tuple[int, int, int]] = field(default_factory=list)
    digests: dict[str, str] = field(default_factory=dict)
    stored: dict[str, str] = field(default_factory=dict)
    is_decoded: bool = False
    payloads: list[dict[str, Any]] = field(default_factory=list)
    flushed: dict[int, Flushed] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"<Recording {self.label}; {len(self.channels)} channels, {self.messages} messages>"

    @property
    def key(self) -> str:
        """The first 64 bits of the id, 16 hexadecimal digits; index documents refer to it."""
        return self.id[:16]

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

    def to_document(self) -> dict[str, Any]:
        """The entry as a mapping of plain values."""
        # `dataclasses.asdict` takes a millisecond for each channel.
        channels = [
            {
                **_values(channel),
                "metadata": dict(channel.metadata),
                "stats": _values(channel.stats),
            }
            for channel in self.channels
        ]
        values = asdict(replace(self, channels=[], flushed={}))
        del values["flushed"]
        return {**values, "channels": channels}

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> RecordingEntry:
        """The entry from such a mapping.

        Raises:
            KeyError: A value is missing.
            TypeError: A value is missing, of another type, or there is one too many.
            ValueError: A segment has no span of its times.
        """
        values = dict(document)
        values["channels"] = [
            _checked(ChannelEntry(**{**c, "stats": _checked(ChannelStats(**c["stats"]))}))
            for c in values["channels"]
        ]
        values["spans"] = [(number, first, last) for number, first, last in values["spans"]]
        if not all(_is_number(one) for span in values["spans"] for one in span):
            raise TypeError("a span is no pair of times")
        return _checked(cls(**values))


_JSON: Final = {"str": str, "int": int, "float": float, "bool": bool, "dict": dict, "list": list}
_KINDS: Final = {
    item: [
        (name, _JSON[kind], "None" in annotation)
        for name, annotation in item.__annotations__.items()
        if (kind := annotation.partition("[")[0].partition(" ")[0]) in _JSON
    ]
    for item in (RecordingEntry, ChannelEntry, ChannelStats)
}
"""Name and type of the attributes of entries, and whether they may be None."""
_E = TypeVar("_E", RecordingEntry, ChannelEntry, ChannelStats)


def _is_number(value: object) -> bool:
    """True for a whole number of 64 bits."""
    if not isinstance(value, int) or isinstance(value, bool):  # BSON has an int of its own
        return False
    return -MAX_INT <= value <= MAX_INT


def _checked(item: _E) -> _E:
    """An item whose values have the types of its attributes.

    Raises:
        TypeError: One has another type.
    """
    for name, wanted, may_lack in _KINDS[type(item)]:
        value = getattr(item, name)
        if value is None and may_lack:
            continue
        if not isinstance(value, wanted) or (wanted is int and not _is_number(value)):
            raise TypeError(f"{name} is no {wanted.__name__}")
    return item


@dataclass(frozen=True, slots=True)
class ChunkEntry:
    """One chunk: its position and its statistics by channel id.

    Attributes:
        recording: Id of its recording.
        segment: Number of its segment.
        number: Its number in the segment, from 0.
        offset: Byte of the chunk record in the file.
        length: Bytes of the chunk record.
        trailer: Bytes of message indexes and arrival numbers behind it.
        crc: CRC-32 of the stored chunk record.
        trailer_crc: CRC-32 of the trailer.
        first: Least log time, ns.
        last: Greatest log time, ns.
        stats: By channel id.
    """

    recording: str
    segment: int
    number: int
    offset: int
    length: int
    trailer: int
    crc: int
    trailer_crc: int
    first: int
    last: int
    stats: Mapping[int, ChannelStats]

    @property
    def place(self) -> ChunkPlace:
        """Its position, as the segment reader expects it."""
        return ChunkPlace(
            offset=self.offset,
            length=self.length,
            trailer=self.trailer,
            first=self.first,
            last=self.last,
            channels=tuple(self.stats),
            number=self.number,
            crc=self.crc,
            trailer_crc=self.trailer_crc,
        )

    @property
    def messages(self) -> int:
        """Number of its messages."""
        return sum(stats.messages for stats in self.stats.values())


def _fingerprints(source: Mapping[str, Any]) -> set[str]:
    """Fingerprints of the log of a recording and of its parts."""
    parts = source.get("parts")
    found = [source.get("fingerprint"), *(parts if isinstance(parts, list) else ())]
    return {fingerprint for fingerprint in found if isinstance(fingerprint, str)}


def channel_totals(
    table: ChunkTable, stamps: NDArray[np.void] | None, silent: Container[int] = ()
) -> dict[int, ChannelStats]:
    """Statistics of the channels of a segment.

    Args:
        table: Its chunks.
        stamps: Results of decoding, a row for each of `table.parts`; None before the
        messages are decoded.
        silent: Ids of channels without publish times.
    """
    parts = table.parts
    found: dict[int, ChannelStats] = {}
    order = np.argsort(parts["channel"], kind="stable")
    ids = parts["channel"][order]
    for begin, end in pairwise([*run_starts(ids).tolist(), len(ids)]):
        rows = parts[order[begin:end]]
        channel = int(ids[begin])
        stats = found[channel] = ChannelStats(
            messages=int(rows["messages"].sum()),
            payload_bytes=int(rows["payload_bytes"].sum()),
            first=int(rows["first"].min()),
            last=int(rows["last"].max()),
            longest=int((rows["last"] - rows["first"]).max()),
        )
        if channel not in silent and not table.is_flushed:
            stats.first_publish = int(rows["first_publish"].min())
            stats.last_publish = int(rows["last_publish"].max())
        if stamps is not None:
            _add_stamps(stats, stamps[order[begin:end]])
    return found


def _add_stamps(stats: ChannelStats, rows: NDArray[np.void]) -> None:
    stats.unreadable = int(rows["unreadable"].sum())
    stats.surplus = int(rows["surplus"].sum())
    rows = rows[rows["stamped"] > 0]
    if len(rows):
        stats.stamped = int(rows["stamped"].sum())
        stats.unset = int(rows["unset"].sum())
        # Exact, so that the order of segments and chunks does not matter.
        stats.skew_sum = math.fsum(rows["skew_sum"].tolist())
        stats.first_stamp = int(rows["first_stamp"].min())
        stats.last_stamp = int(rows["last_stamp"].max())
    rows = rows[rows["stamped"] > rows["unset"]]
    if len(rows):
        stats.skew_min = int(rows["skew_min"].min())
        stats.skew_max = int(rows["skew_max"].max())


def stamps_of(
    table: ChunkTable, chunks: Mapping[int, Mapping[int, ChannelStats]]
) -> NDArray[np.void]:
    """Header stamps and decoding failures of a segment, a row for each row of `table.parts`.

    Args:
        table: The segment's chunks.
        chunks: Statistics by channel, for each chunk number that could be decoded.
    """
    rows = np.zeros(len(table.parts), _STAMPS)
    bounds = table.part_bounds().tolist()
    for number, by_channel in chunks.items():
        for row in range(bounds[number], bounds[number + 1]):
            stats = by_channel.get(int(table.parts["channel"][row]))
            if stats is not None:
                rows[row] = _decoded(stats)
    return rows


def decoded_rows(chunks: Iterable[Mapping[int, ChannelStats]]) -> NDArray[np.void]:
    """The same of a segment whose chunks could all be decoded.

    Args:
        chunks: Statistics by channel, for each chunk of the segment.
    """
    rows = [_decoded(stats) for one in chunks for _, stats in sorted(one.items())]
    return np.array(rows, _STAMPS)


def _decoded(stats: ChannelStats) -> tuple[float, ...]:
    """A row of the results of decoding."""
    return (
        stats.unreadable,
        stats.surplus,
        stats.stamped,
        stats.unset,
        stats.first_stamp or 0,
        stats.last_stamp or 0,
        stats.skew_sum,
        stats.skew_min or 0,
        stats.skew_max or 0,
    )


@dataclass(frozen=True, slots=True)
class Described:
    """A recording, as read from its files.

    Attributes:
        entry: Its entry.
        summary: Its summary.
        topics: Its topics and their types.
        files: State of the files; the row is used while it is unchanged.
        channels: By id.
    """

    entry: RecordingEntry
    summary: RecordingSummary
    topics: Collection[TopicType]
    files: str
    channels: Mapping[int, Channel]


@dataclass(slots=True)
class _Part:
    """The list of a part.

    Attributes:
        version: As of the folder; empty before it was read again.
        size: Bytes of the file.
        summaries: By id; None for recordings without one.
        shared: Sets of topics as text, by kind and hash.
        damage: Lists of unreadable chunks as text, by id.
        lines: Lines with bounds.
        bounds: Those that were asked about, by kind and id.
    """

    version: Version = ()
    size: int = 0
    lines: bytes = b""
    summaries: dict[str, RecordingSummary | None] = field(default_factory=dict)
    shared: dict[tuple[str, str], str] = field(default_factory=dict)
    damage: dict[str, str] = field(default_factory=dict)
    bounds: dict[str, dict[str, Ends]] = field(default_factory=dict)

    @classmethod
    def of(cls, content: PartContent, version: Version, data: bytes) -> _Part:
        """The list of a part."""
        sets = {key: text for key, text in content.shared.items() if _are_topics(*key, text)}
        found = cls(version, len(data), bounds_in(data), shared=sets)
        for recording, row in content.rows.items():
            found.summaries[recording] = None
            if SUMMARY in row:
                index, _, text = row[SUMMARY].partition(" ")
                # A list of unreadable chunks may be lost; the index has it, too.
                index = index.strip("-") if content.is_whole else ""
                with suppress(TypeError, ValueError):
                    summary = RecordingSummary.from_values(json.loads(text), index)
                    if (TOPICS, summary.topics) in sets and summary.id == recording:
                        found.summaries[recording] = summary
            if DAMAGE in row:
                found.damage[recording] = row[DAMAGE]
        return found

    def bounds_of(self, kind: str) -> dict[str, Ends]:
        """Bounds of one kind by recording."""
        if kind not in self.bounds:
            texts = texts_in(self.lines, kind)
            self.bounds[kind] = {}
            with suppress(TypeError, ValueError):
                for recording, text in texts.items():
                    low, high = json.loads(text)
                    if {type(low), type(high)} <= {int, float} or low is high is None:
                        self.bounds[kind][recording] = low, high
        return self.bounds[kind]


class Catalog:
    """The catalog of a store. Thread safe.

    Args:
        store: The store's directory.
        store_id: The store's id; what is of another store is removed.
        in_memory: Leave no file, for a store that this user cannot write.
        folder: Its files, if they lie elsewhere.

    Attributes:
        was_damaged: True if something damaged was found since this was last set to False.
        locked: The folder, if another process keeps it locked; a catalog in memory replaces it.
        has_changed: True if an ended recording was changed by this process.
    """

    def __init__(
        self,
        store: Path,
        store_id: str,
        *,
        in_memory: bool = False,
        folder: MemoryFolder | None = None,
    ) -> None:
        self.was_damaged = False
        self.has_changed = False
        self.locked: Path | None = None
        self._store = store
        self._store_id = store_id
        self._lock = RLock()
        self._folder = folder or MemoryFolder()
        self._parts: dict[int, _Part] = {}
        self._places: dict[str, int] = {}  # number of its part, by id of a recording
        self._by_fingerprint: dict[str, list[str]] | None = None
        self._odd: set[str] = set()  # names of files that are not ours, or left over
        self._damaged: set[int] = set()  # numbers of parts
        self._pending: dict[str, Described] = {}  # by recording; written when this is closed
        # Bounds and the content that they are of, by kind and recording.
        self._noted: dict[str, dict[str, tuple[str, Ends]]] = defaultdict(dict)
        self._tables = Cache(_MAX_TABLES)
        if not in_memory and folder is None:
            self._folder = DiskFolder(store / CATALOG)
            self._check_folder()

    @property
    def path(self) -> Path:
        """Its folder."""
        return self._store / CATALOG

    @property
    def recordings_file(self) -> Path:
        """The list of ended recordings for other readers; it is removed before they change."""
        return self._store / _RECORDINGS_FILE

    @property
    def is_in_memory(self) -> bool:
        """True if it exists in the memory of this process only."""
        return not isinstance(self._folder, DiskFolder)

    def close(self) -> None:
        """Write what was kept and noted, drop the rest, and remove what is damaged."""
        with self._lock:
            self.write_pending()
            self._store_noted()
            self._invalidate()
            self.drop_damaged()

    def _check_folder(self) -> None:
        try:
            kind = files.status(self.path).st_mode
            if stat.S_ISLNK(kind):
                raise StoreError(f"{self.path} is a symlink. Delete it: the catalog is rebuilt.")
            if not stat.S_ISDIR(kind):
                self.was_damaged = True
                files.remove_tree(self.path)
        except FileNotFoundError:
            pass  # it is made with the first recording
        except OSError as error:
            raise durability.explain(error, self.path, "opening") from error

    # Parts.

    def _follow(self) -> None:
        """Read the lists of parts that have changed.

        Raises:
            StoreError: The folder cannot be read.
        """
        if not self._folder.has_changed():
            return
        try:
            versions = self._folder.versions()
        except NotADirectoryError:  # ELOOP for a symlink
            self._check_folder()
            versions = {}
        except OSError as error:
            raise durability.explain(error, self.path, "reading") from error
        parts: dict[int, _Part] = {}
        self._odd = set()
        for name, version in versions.items():
            number = number_of(name)
            if number is None:
                if not name.startswith(_SCHEMA):
                    self._odd.add(name)
                continue
            known = self._parts.get(number)
            is_known = known is not None and known.version == version
            found = known if is_known else self._read_list(name, version)
            if found is not None:
                parts[number] = found
                if not is_known:  # another process may have read recordings again
                    before = {} if known is None else known.summaries
                    after = found.summaries.items()
                    self._drop_noted([one for one, now in after if before.get(one) != now])
        self._parts = parts
        self._place()

    def _place(self) -> None:
        self._by_fingerprint = None
        self._places = {
            recording: number
            for number, part in sorted(self._parts.items())
            for recording in part.summaries
        }

    def _read_list(self, name: str, version: Version) -> _Part | None:
        data = self._data_of(name)
        if data is None:
            return None
        if is_of_another(self._store_id, data):
            self._odd.add(name)
            return None
        found = PartContent.from_bytes(self._store_id, data, is_list=True)
        self._check(number_of(name) or 0, found)
        return _Part.of(found, version, data)

    def _read(self, number: int) -> PartContent:
        """Everything in a part but what is damaged; nothing if it does not exist."""
        data = self._data_of(part_name(number))
        if data is None or is_of_another(self._store_id, data):
            return PartContent()
        found = PartContent.from_bytes(self._store_id, data)
        self._check(number, found)
        return found

    def _check(self, number: int, content: PartContent) -> None:
        if not content.is_whole:
            self.was_damaged = True
            self._damaged.add(number)

    def _data_of(self, name: str) -> bytes | None:
        """The content of a file; nothing if it cannot be read, None if it does not exist."""
        try:
            return self._folder.read(name)
        except FileNotFoundError:
            return None
        except OSError as error:
            short = exhausted(error.errno, f"reading {self.path / name}")
            if short is not None:
                raise short from error
            return b""

    @contextmanager
    def _changing(self) -> Iterator[None]:
        """A change of some parts, without other writers.

        Raises:
            DiskFullError: There is no room.
            StoreError: They cannot be written.
        """
        with self._lock, ExitStack() as stack:
            try:
                try:
                    stack.enter_context(self._folder.lock(_BUSY_S))
                except NotADirectoryError:
                    self._check_folder()
                    stack.enter_context(self._folder.lock(_BUSY_S))
            except BlockingIOError:
                self.locked, copy = self.path, MemoryFolder()
                for name in self._folder.versions():
                    copy.write(name, self._data_of(name) or b"")
                self._folder = copy
            except OSError as error:
                raise durability.explain(error, self.path, "writing") from error
            try:
                self._follow()
                self._tidy()
                yield
            except OSError as error:
                raise durability.explain(error, self.path, "writing") from error

    @contextmanager
    def unchanged(self) -> Iterator[list[RecordingSummary]]:
        """All summaries, while nobody changes them.

        Raises:
            StoreError: They cannot be read.
        """
        with self._changing():
            yield self.summaries()

    def _remove_recordings_file(self) -> None:
        self.has_changed = True
        if self.locked is not None or not self.is_in_memory:
            with suppress(FileNotFoundError):
                files.unlink(self.recordings_file)

    def _tidy(self) -> None:
        """Remove files that are not ours, and what is damaged."""
        for name in self._odd:
            self._folder.remove(name)
        self._odd.clear()
        for number in self._damaged & self._parts.keys():
            content = self._read(number)
            for row in content.rows.values():  # what is lost is not known
                row.pop(ENTRY, None)
                if SUMMARY in row:
                    row[SUMMARY] = f"- {row[SUMMARY].partition(' ')[2]}"
            self._write(number, content)
        self._damaged.clear()

    def _write(self, number: int, content: PartContent) -> None:
        """Replace a part."""
        name = part_name(number)
        # A recording that got another part is listed there.
        rows = {r: row for r, row in content.rows.items() if self._places.get(r, number) == number}
        if not rows:
            self._folder.remove(name)
            self._parts.pop(number, None)
            return
        texts = [row[SUMMARY] for row in rows.values() if SUMMARY in row]
        sets = {json.loads(text.partition(" ")[2])[_TOPICS] for text in texts}
        shared = {key: text for key, text in content.shared.items() if key[1] in sets}
        whole = PartContent(rows, shared)
        data = whole.to_bytes(self._store_id)
        self._folder.write(name, data)
        self._parts[number] = _Part.of(whole, (), data)

    def _change(self, recording: str, change: Callable[[dict[str, str]], None], *sets: str) -> None:
        """Change the row of a recording; an empty one is removed.

        Args:
            recording: Its id.
            change: Changes its texts by kind.
            sets: Sets of topics that it may have, as text.
        """
        with self._changing():
            number = self._places.get(recording)
            if number is None:  # the smallest part takes it
                sizes = {n: part.size for n, part in self._parts.items()}
                number = min(sizes, key=sizes.__getitem__, default=0)
            content = self._read(number)
            row = content.rows.setdefault(recording, {})
            change(row)
            content.shared.update(((TOPICS, hash_of(text)), text) for text in sets)
            self._by_fingerprint = None
            self._places.pop(recording, None)
            if not row:
                del content.rows[recording]
            elif len(content.rows) > 1 and content.size > MAX_PART_BYTES:
                self._places[recording] = free = max(self._parts) + 1
                self._write(free, PartContent({recording: row}, content.shared))
            else:
                self._places[recording] = number
            self._write(number, content)

    # Changes.

    def keep(self, described: Described) -> None:
        """Insert or replace a recording; it is written when this is closed."""
        if self.is_in_memory:
            self.put(described)
            return
        with self._lock:
            self._invalidate(described.entry.id)
            self._by_fingerprint = None
            self._pending[described.entry.id] = described

    def write_pending(self) -> None:
        """Write what was kept, as far as that is possible."""
        with self._lock:
            with suppress(StoreError, ResourceError):
                for described in [*self._pending.values()]:
                    self.put(described)
            self._pending.clear()

    def put(self, described: Described) -> None:
        """Insert or replace a recording."""
        entry = described.entry
        # In ASCII: a directory's name may not be UTF-8.
        text = json.dumps([described.files, entry.to_document()], separators=(",", ":"))

        def change(row: dict[str, str]) -> None:
            if entry.status != "open":
                self._remove_recordings_file()
            kinds = [kind for kind in row if kind.startswith(BOUNDS)]
            if kinds and _content_of(row) != content_of(entry.digests):
                for kind in kinds:
                    del row[kind]
            row[ENTRY] = text
            row[SUMMARY] = f"- {described.summary.to_json()}"

        with self._lock:
            self._pending.pop(entry.id, None)
            self._invalidate(entry.id)
        self._put_schemas({c.schema for c in described.channels.values() if c.schema is not None})
        self._change(entry.id, change, topics_to_json(described.topics))

    def put_looks(self, summaries: Iterable[RecordingSummary]) -> None:
        """Note that recordings are unchanged although their directories look different."""
        texts = {one.id: one.to_json() for one in summaries}

        def change(recording: str, row: dict[str, str]) -> None:
            row[SUMMARY] = f"{row[SUMMARY].partition(' ')[0]} {texts[recording]}"

        self._note(texts, change)

    def put_indexed(self, recordings: Iterable[str], index: str) -> None:
        """Note which index is complete for recordings.

        Args:
            recordings: Their ids.
            index: The id of the index; empty if none is.
        """

        def change(_: str, row: dict[str, str]) -> None:
            row[SUMMARY] = f"{index or '-'} {row[SUMMARY].partition(' ')[2]}"

        self._note(recordings, change)

    def _note(
        self, recordings: Iterable[str], change: Callable[[str, dict[str, str]], None]
    ) -> None:
        """Change listed recordings; this saves work later, and is left out if it fails."""
        wanted = [*recordings]
        if not wanted:
            return
        with suppress(StoreError, ResourceError), self._changing():
            by_part: dict[int, list[str]] = defaultdict(list)
            for recording in wanted:
                if recording in self._places:
                    by_part[self._places[recording]].append(recording)
            for number, own in by_part.items():
                content = self._read(number)
                for recording in own:
                    if SUMMARY in content.rows.get(recording, {}):
                        change(recording, content.rows[recording])
                self._write(number, content)

    def remove(self, recording: str) -> None:
        """Remove a recording."""

        def clear(row: dict[str, str]) -> None:
            self._remove_recordings_file()
            row.clear()

        with self._lock:
            self._pending.pop(recording, None)
            self._invalidate(recording)
        self._change(recording, clear)

    def put_stamps(
        self, recording: str, stamps: Iterable[tuple[int, str, NDArray[np.void]]]
    ) -> None:
        """Store the decoding results of a recording's segments.

        Args:
            recording: Its id.
            stamps: Number and digest of a segment, and a row for each of the `parts` of its
                chunk table.
        """
        texts = {
            f"{STAMPS}{number}": f"{digest} {b64encode(compress(rows.tobytes(), 1)).decode()}"
            for number, digest, rows in stamps
        }
        with self._lock:
            self._invalidate(recording)
        self._change(recording, lambda row: row.update(texts))

    def put_damage(self, recording: str, damage: Mapping[tuple[int, int], str]) -> None:
        """Store the unreadable chunks of a recording: reason by segment and number."""
        text = json.dumps([(*place, reason) for place, reason in sorted(damage.items())])
        self._change(recording, lambda row: row.update({DAMAGE: text}))

    def rebuild(self) -> None:
        """Replace the catalog with an empty one.

        Raises:
            StoreError: It cannot be written.
        """
        with self._lock:
            self.was_damaged |= not self.is_in_memory
            self._pending.clear()
            self._invalidate()
            with self._changing():
                self._remove_recordings_file()
                for name in self._folder.versions():
                    self._folder.remove(name)
            self._parts, self._places = {}, {}

    def mend(self) -> None:
        """Look at everything, and remove what is damaged.

        Raises:
            StoreError: It cannot be read or written.
        """
        if not self.is_sound():
            with self._changing():
                pass

    def drop_damaged(self) -> None:
        """Remove what was found to be damaged, if it can be written."""
        with self._lock:
            if self._damaged:
                with suppress(StoreError, ResourceError), self._changing():
                    pass

    # Answers.

    def is_sound(self, labels: Collection[str] | None = None) -> bool:
        """True if nothing in it is damaged.

        Args:
            labels: Look at parts with these recordings only; None for all.

        Raises:
            StoreError: It cannot be read.
        """
        with self._lock:
            self._follow()
            chosen = {*self._parts}
            if labels is not None:
                wanted = {one.id for one in self.summaries() if one.label in labels}
                chosen = {self._places[recording] for recording in wanted}
            whole = [self._read(number).is_whole for number in [*chosen]]
            return all(whole) and not self._odd and not self._damaged

    def summaries(self, recordings: Collection[str] | None = None) -> list[RecordingSummary]:
        """Summaries of recordings by id, None for all; unordered, without damaged ones.

        Raises:
            StoreError: It cannot be read.
        """
        with self._lock:
            self._follow()
            wanted = {*self._places} if recordings is None else self._places.keys() & {*recordings}
            found = [
                self._parts[self._places[one]].summaries[one]
                for one in wanted - self._pending.keys()
            ]
            pending = [
                one.summary
                for recording, one in self._pending.items()
                if recordings is None or recording in recordings
            ]
        return [summary for summary in found if summary is not None] + pending

    def topics(self, digest: str) -> tuple[TopicType, ...]:
        """A set of topics and their types, by its hash.

        Raises:
            CatalogError: Another process has changed the recordings that had it.
        """
        with self._lock:
            for one in self._pending.values():
                if one.summary.topics == digest:
                    return topics_from_json(topics_to_json(one.topics))
            key = TOPICS, digest
            found = next((p.shared[key] for p in self._parts.values() if key in p.shared), "")
        if hash_of(found) != digest:
            raise CatalogError(f"Topics in the catalog {self.path} change all the time. Ask again.")
        return topics_from_json(found)

    def _row(self, recording: str) -> dict[str, str]:
        """All texts of a recording by kind."""
        with self._lock:
            if recording not in self._places:
                self._follow()
            number = self._places.get(recording)
            row = self._read(number).rows.get(recording) if number is not None else None
            if row is None and number is not None:  # another process may have moved it
                self._follow()
                row = self._read(self._places.get(recording, number)).rows.get(recording)
            return row or {}

    def recording(self, recording: str) -> tuple[str, RecordingEntry] | None:
        """State of the files and entry of a recording; None if it is missing or damaged."""
        pending = self._pending.get(recording)
        if pending is not None:
            return pending.files, pending.entry
        row = self._row(recording)
        with suppress(KeyError, TypeError, ValueError):
            looks, document = json.loads(row[ENTRY])
            entry = RecordingEntry.from_document(document)
            if isinstance(looks, str) and entry.id == recording:
                return looks, entry
        return None

    def with_fingerprint(self, fingerprint: str) -> RecordingEntry | None:
        """A recording of a log with this content, or of one of which it is a part."""
        with self._lock:
            summaries = self.summaries()
            if self._by_fingerprint is None:
                self._by_fingerprint = defaultdict(list)
                for one in summaries:
                    for known in _fingerprints(one.source):
                        self._by_fingerprint[known].append(one.id)
            recordings = self._by_fingerprint.get(fingerprint, [])
        found = (self.recording(recording) for recording in recordings)
        return next((row[1] for row in found if row is not None), None)

    def damage(self, recording: str) -> dict[tuple[int, int], str]:
        """The unreadable chunks of a recording: reason by segment and number."""
        with self._lock:
            self._follow()
            part = self._parts.get(self._places.get(recording, -1))
            text = part.damage.get(recording, "[]") if part is not None else "[]"
        with suppress(TypeError, ValueError):
            rows = json.loads(text)
            return {(int(segment), int(chunk)): str(reason) for segment, chunk, reason in rows}
        return {}

    def stamps(
        self, entry: RecordingEntry, number: int, table: ChunkTable
    ) -> NDArray[np.void] | None:
        """Decoding results of a segment; None before its messages are decoded."""
        digest, _, text = self._row(entry.id).get(f"{STAMPS}{number}", "").partition(" ")
        with suppress(ValueError, ZlibError):
            most = len(table.parts) * _STAMPS.itemsize
            rows = np.frombuffer(decompressobj().decompress(b64decode(text), most + 1), _STAMPS)
            if digest == entry.digests.get(str(number)) and len(rows) == len(table.parts):
                return rows
        return None

    # Bounds.

    def bounds(self, kind: str) -> dict[str, Ends]:
        """Known bounds of one kind, by recording; see `note_bounds`."""
        with self._lock:
            found = {
                recording: ends
                for number, part in self._parts.items()
                for recording, ends in part.bounds_of(f"{BOUNDS}{kind}").items()
                if self._places.get(recording) == number
            }
            noted = self._noted.get(kind, {})
            return found | {recording: ends for recording, (_, ends) in noted.items()}

    def note_bounds(self, kind: str, entry: RecordingEntry, ends: Ends) -> None:
        """Note the bounds of numbers of a recording; they are written when this is closed.

        Args:
            kind: What they are bounds of, in a word.
            entry: The recording; bounds hold for the content of its segments.
            ends: The bounds, without NaN.
        """
        with self._lock:
            if sum(map(len, self._noted.values())) >= _MAX_NOTED:
                self._noted.clear()
            self._noted[kind][entry.id] = content_of(entry.digests), ends

    def _drop_noted(self, recordings: Iterable[str]) -> None:
        for noted in self._noted.values():
            for recording in recordings:
                noted.pop(recording, None)

    def _store_noted(self) -> None:
        """Write bounds that were noted, of as many recordings as takes a second."""
        noted, self._noted = self._noted, defaultdict(dict)
        recordings = {recording for own in noted.values() for recording in own}
        places = sorted({self._places[one] for one in recordings & self._places.keys()})
        chosen = {*places[:_MAX_BOUNDED_PARTS]}

        def change(recording: str, row: dict[str, str]) -> None:
            known = _content_of(row)
            own = {
                f"{BOUNDS}{kind}": json.dumps(found[recording][1], separators=(",", ":"))
                for kind, found in noted.items()
                if recording in found and found[recording][0] == known
            }
            part = self._parts[self._places[recording]]
            room = (_MAX_BOUNDED_BYTES - part.size) // (_BOUND_BYTES * len(part.summaries))
            if room <= 0:
                for kind in [kind for kind in row if kind.startswith(BOUNDS)]:
                    del row[kind]
            row.update([*own.items()][-max(room, 1) :])

        self._note([one for one in recordings if self._places.get(one) in chosen], change)

    # Schemas.

    def _put_schemas(self, schemas: Collection[Schema]) -> None:
        known = {schema_hash(schema): schema for schema in schemas}
        missing = known.keys() - self.schemas(known).keys()
        if missing:
            with self._changing():
                for digest in missing:
                    schema = known[digest]
                    head = json.dumps([schema.name, schema.encoding]).encode()
                    self._folder.write(f"{_SCHEMA}{digest}", head + b"\n" + bytes(schema.data))

    def schemas(self, hashes: Collection[str]) -> dict[str, Schema]:
        """Schemas by hash, without missing or damaged ones."""
        found: dict[str, Schema] = {}
        for digest in hashes:
            head, _, text = (self._data_of(f"{_SCHEMA}{digest}") or b"").partition(b"\n")
            with suppress(TypeError, ValueError):
                name, encoding = json.loads(head)
                schema = Schema(name, encoding, text)
                if schema_hash(schema) == digest:
                    found[digest] = schema
        if len(found) < len(hashes):
            for one in [*self._pending.values()]:
                own = (channel.schema for channel in one.channels.values())
                known = {schema_hash(schema): schema for schema in own if schema is not None}
                found |= {digest: known[digest] for digest in known.keys() & {*hashes}}
        return found

    # Chunks.

    def table(self, entry: RecordingEntry, number: int) -> ChunkTable:
        """The chunks of a segment, from its footer.

        Raises:
            CatalogError: The segment is not the one of the entry, or cannot be read.
        """
        return self.decoded_table(entry, number)[0]

    def decoded_table(
        self, entry: RecordingEntry, number: int
    ) -> tuple[ChunkTable, NDArray[np.void] | None]:
        """The chunks of a segment, and the results of decoding for each row of its parts.

        Raises:
            CatalogError: The segment is not the one of the entry, or cannot be read.
        """
        if number in entry.flushed:
            return entry.flushed[number].table, None
        digest = entry.digests.get(str(number), "")
        return self._tables.made(
            "table",
            entry.id,
            number,
            entry.stored.get(str(number), digest),
            make=lambda: self._read_table(entry, number, digest),
            size_of=lambda found: _size(found[0]),
        )

    def _read_table(
        self, entry: RecordingEntry, number: int, digest: str
    ) -> tuple[ChunkTable, NDArray[np.void] | None]:
        path = self._store / _RECORDINGS / entry.label / sealed_name(number)
        try:
            with SegmentReader(path, number) as reader:
                summary = reader.summary()
        except SegmentError as error:
            raise CatalogError(str(error)) from error
        # Expired messages are on other channels than before.
        is_expired = bool(summary.table.is_expired.any())
        is_known = summary.digest == entry.stored.get(str(number), digest) or not is_expired
        is_ours = summary.recording.get("id") == entry.id and summary.whole_digest == digest
        if not (is_ours and is_known):
            raise CatalogError(f"Segment {path} has changed since the store was opened.")
        return summary.table, self.stamps(entry, number, summary.table)

    def chunk_stats(
        self, entry: RecordingEntry, segment: int, number: int
    ) -> dict[int, ChannelStats]:
        """Statistics of the channels in a chunk.

        Raises:
            CatalogError: As for `table`.
        """
        table, stamps = self.decoded_table(entry, segment)
        begin, end = table.part_bounds()[number : number + 2].tolist()
        own = replace(table, chunks=table.chunks[number : number + 1], parts=table.parts[begin:end])
        silent = {c.id for c in entry.channels if not c.has_publish_time}
        return channel_totals(own, None if stamps is None else stamps[begin:end], silent)

    def _invalidate(self, recording: str | None = None) -> None:
        if recording is None:
            self._noted.clear()
            self._tables.drop("table")
        else:
            self._drop_noted([recording])
            self._tables.drop("table", recording)


def _are_topics(kind: str, key: str, text: str) -> bool:
    """True for the set of topics that a hash belongs to."""
    if kind != TOPICS or hash_of(text) != key:
        return False
    with suppress(TypeError, ValueError):
        return all(isinstance(word, str) for one in topics_from_json(text) for word in one)
    return False


def content_of(digests: Mapping[str, str]) -> str:
    """A hash of the content of a recording's segments, by their digests."""
    return hash_of(json.dumps(sorted(digests.items())))


def _content_of(row: Mapping[str, str]) -> str:
    """The same of a row; empty without an entry."""
    with suppress(KeyError, TypeError, ValueError, AttributeError):
        return content_of(json.loads(row[ENTRY])[1]["digests"])
    return ""


def schema_hash(schema: Schema) -> str:
    """SHA-256 of name, encoding and definition, as hex digits."""
    digest = hashlib.sha256()
    for part in (schema.name.encode(), schema.encoding.encode(), bytes(schema.data)):
        digest.update(len(part).to_bytes(8, "little") + part)
    return digest.hexdigest()


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


def _size(table: ChunkTable) -> int:
    return int(table.chunks.nbytes + table.parts.nbytes + table.others.nbytes)


def _least(a: int | None, b: int | None) -> int | None:
    return b if a is None else a if b is None else min(a, b)


def _greatest(a: int | None, b: int | None) -> int | None:
    return b if a is None else a if b is None else max(a, b)
