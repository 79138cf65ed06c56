"""Fields of whole topics as columns in memory, for who asks about them again and again.

A recording that has ended does not change. So a field of all its messages can be kept as
an array, and what is asked of it next takes a pass over numbers. Getting it costs as much as
some questions to MongoDB, and is done when as much has been spent on such questions.
"""

from __future__ import annotations

import threading
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hybridlog.columns.topic import (
    SINGLE_READ,
    TopicColumns,
    UnfitError,
    in_order,
    is_small,
    nbytes,
    singles,
    types_of,
)
from hybridlog.frames.bson import records_from_bson
from hybridlog.indexing import rows_by_channel
from hybridlog.query.plan import Sweep
from hybridlog.query.times import TIME_LIMIT
from hybridlog.schema.column import concatenate
from hybridlog_storage.errors import SegmentError, StoreError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.columns.judged import Judged
    from hybridlog.query.column_filter import Single
    from hybridlog.query.plan import Counters, Lane
    from hybridlog.query.predicate import Predicate
    from hybridlog.reader import Query
    from hybridlog.store import Store
    from hybridlog_storage.catalog import ChannelStats, RecordingEntry

MOST_BYTES = 256 << 20
"""Most memory that the columns of a store take; getting some takes up to four times theirs."""
_MOST_QUESTIONS = 128  # that are remembered
_RECORD_BYTES = 40  # that a message takes in a chunk besides its payload, about
# What things cost, in seconds, on a small machine; only their ratios matter.
_QUESTION_S = 1e-3
_LOOK_S = 0.6e-6  # at a document, by MongoDB
_DOCUMENT_S = 4e-6  # sent by MongoDB and made a row
_BYTE_S = 1.3e-9  # of a chunk, uncompressed, read


class _Way(NamedTuple):
    """A way to get columns: what it costs, about, in seconds."""

    price: float
    load: Callable[[Mapping[str, str], bool, Counters], TopicColumns]


class Asked(NamedTuple):
    """What is asked of the messages of a topic, of ranges of time apart.

    Attributes:
        topic: Full name.
        recording_ids: In which recordings.
        predicates: All must hold. The same objects are the same predicates: `1` and `True`
            are equal, and not the same.
        fields: Paths of fields that are needed besides those of the predicates.
        ordered: Whether log times and arrival numbers are needed.
    """

    topic: str
    recording_ids: tuple[str, ...]
    predicates: tuple[Predicate, ...]
    fields: frozenset[str]
    ordered: bool


class _Wanted(NamedTuple):
    """What a question needs of a topic: fields, and perhaps their order."""

    fields: frozenset[str]
    ordered: bool

    def is_in(self, columns: TopicColumns) -> bool:
        has_order = columns.order is not None or not self.ordered
        return has_order and self.fields <= columns.fields.keys()


class KeptColumns:
    """The columns of a store. Thread safe.

    Args:
        store: With its database.

    Attributes:
        most_bytes: Most memory they take; 0 for none at all.
    """

    def __init__(self, store: Store) -> None:
        self.most_bytes = MOST_BYTES
        self._store = store
        self._kept: OrderedDict[tuple[str, str], TopicColumns] = OrderedDict()
        self._known: dict[Asked, tuple[Judged, ...]] = {}
        self._types: dict[tuple[str, str], Mapping[str, str] | None] = {}
        self._unfit: set[tuple[str, str]] = set()
        self._spent: defaultdict[str, float] = defaultdict(float)
        self._generation = 0
        self._lock = threading.RLock()
        self._loading = threading.Lock()

    def clear(self) -> None:
        """Forget everything."""
        with self._lock:
            self._generation += 1  # what is on its way is of the past
            self._kept.clear()
            self._known.clear()
            self._types.clear()
            self._unfit.clear()
            self._spent.clear()

    def types(self, recording: RecordingEntry, topic: str) -> Mapping[str, str] | None:
        """Fields that can be kept of a topic in a recording, and their types; None if none can.

        Messages that could not be read have no fields, and those of which little is left
        are documents already.
        """
        key = recording.id, topic
        with self._lock:
            generation = self._generation
            if key in self._types:
                return self._types[key]
        types = self._types_of(recording, topic)
        with self._lock:
            if generation == self._generation:
                self._types[key] = types
        return types

    def _types_of(self, recording: RecordingEntry, topic: str) -> Mapping[str, str] | None:
        lanes = self._lanes(recording, topic)
        stats = recording.stats_of(topic)
        one_codec = len({id(lane.codec) for lane in lanes}) == 1
        if (
            recording.status == "open"
            or recording.span is None
            or not one_codec
            or any(s.unreadable for s in stats)
        ):
            return None
        if lanes[0].is_reduced or not lanes[0].codec.indexed:
            return None
        return types_of(lanes[0].codec)

    def recall(self, asked: Asked) -> tuple[Judged, ...] | None:
        """What was remembered of a question; None once columns have come or gone since."""
        with self._lock:
            known = self._known.get(asked)
            for part in known or ():
                self._kept.move_to_end((part.recording.id, asked.topic))
        return known

    def remember(self, asked: Asked, parts: tuple[Judged, ...]) -> None:
        """What a question means is not found out again as long as its columns are kept."""
        with self._lock:
            if any(
                self._kept.get((part.recording.id, asked.topic)) is not part.columns
                for part in parts
            ):
                return
            if len(self._known) >= _MOST_QUESTIONS:
                self._known.clear()
            self._known[asked] = parts

    def find(
        self,
        topic: str,
        recordings: Sequence[RecordingEntry],
        fields: Collection[str],
        *,
        ordered: bool,
        instead_s: Callable[[], float],
        counters: Counters,
    ) -> list[TopicColumns] | None:
        """Columns of fields of a topic, of each recording; None when they are not worth it.

        Args:
            topic: Full name.
            recordings: Those wanted, all of which `types` knows the fields of.
            fields: Paths.
            ordered: Whether log times and arrival numbers are wanted, too.
            instead_s: Says what the answer costs without them, see `cost_s`.
            counters: Get what is read.
        """
        wanted = _Wanted(frozenset(fields), ordered)
        with self._lock:
            generation = self._generation
            found, missing = self._look(topic, recordings, wanted)
            ways = {r.id: self._cheapest_way(r, topic, wanted) for r in missing}
            price = sum(way.price for way in ways.values())
            if missing and not self._is_worth(topic, recordings, wanted, price, instead_s()):
                return None
        if missing:
            # Of several who want the same at once, the first one gets it for all.
            with self._loading:
                with self._lock:
                    found, missing = self._look(topic, recordings, wanted)
                for recording in missing:
                    way = ways.get(recording.id) or self._cheapest_way(recording, topic, wanted)
                    load = partial(self._load, recording, topic, way, counters)
                    key = recording.id, topic
                    try:
                        found[key] = self._completed(found.get(key), wanted, load)
                    except UnfitError:
                        with self._lock:
                            if generation == self._generation:
                                self._unfit.add((recording.id, topic))
                        return None
                self._keep(found, generation)
        return [found[recording.id, topic] for recording in recordings]

    def _look(
        self, topic: str, recordings: Sequence[RecordingEntry], wanted: _Wanted
    ) -> tuple[dict[tuple[str, str], TopicColumns], list[RecordingEntry]]:
        """What is kept, and recordings of which something is missing."""
        found: dict[tuple[str, str], TopicColumns] = {}
        missing = []
        for recording in recordings:
            key = recording.id, topic
            kept = self._kept.get(key)
            if kept is not None:
                found[key] = kept
                self._kept.move_to_end(key)
            if kept is None or not wanted.is_in(kept):
                missing.append(recording)
        return found, missing

    def _completed(
        self,
        kept: TopicColumns | None,
        wanted: _Wanted,
        load: Callable[[_Wanted], TopicColumns],
    ) -> TopicColumns:
        """What is kept of a recording, with what is missing."""
        if kept is None:
            return load(wanted)
        missing = _Wanted(wanted.fields - kept.fields.keys(), wanted.ordered and not kept.order)
        loaded = load(missing)
        fields = {**kept.fields, **loaded.fields}
        if sum(map(nbytes, fields.values())) > self.most_bytes / 2:
            fields = {path: fields[path] for path in wanted.fields}  # these at least have room
        return TopicColumns(kept.rows, kept.order or loaded.order, fields)

    def _is_worth(
        self,
        topic: str,
        recordings: Sequence[RecordingEntry],
        wanted: _Wanted,
        price: float,
        instead_s: float,
    ) -> bool:
        """Whether to get columns now: enough was spent, and all of them have room together."""
        if any((recording.id, topic) in self._unfit for recording in recordings):
            return False
        if sum(self._size(r, topic, wanted.fields) for r in recordings) > self.most_bytes:
            return False
        # An answer that alone costs twice as much as the columns is worth them at once.
        if self._spent[topic] + instead_s / 2 < price:
            self._spent[topic] += instead_s
            return False
        self._spent[topic] = 0.0
        return True

    def _size(self, recording: RecordingEntry, topic: str, fields: Collection[str]) -> int:
        """Most memory that columns take."""
        types = self.types(recording, topic) or {}
        has_text = any(types.get(path) == "string" for path in fields)
        text = sum(s.payload_bytes for s in recording.stats_of(topic)) if has_text else 0
        return recording.messages_of(topic) * 8 * (2 + len(fields)) + text

    def _cheapest_way(self, recording: RecordingEntry, topic: str, wanted: _Wanted) -> _Way:
        """How columns are got for the least."""
        question = partial(self._question, recording, topic)
        messages = recording.messages_of(topic)
        ways = [_Way(_QUESTION_S + _DOCUMENT_S * messages, partial(_from_index, question))]
        encodings = {lane.channel.message_encoding for lane in self._lanes(recording, topic)}
        if encodings <= SINGLE_READ:
            # Small messages of all topics share chunks, large ones have their own.
            is_own = not all(map(_is_small, recording.stats_of(topic)))
            read = [
                c.stats
                for c in recording.channels
                if c.topic == topic or (_is_small(c.stats) and not is_own)
            ]
            size = sum(s.payload_bytes + _RECORD_BYTES * s.messages for s in read)
            ways.append(_Way(_QUESTION_S + _BYTE_S * size, partial(_from_segments, question)))
        return min(ways, key=lambda way: way.price)

    def _load(
        self,
        recording: RecordingEntry,
        topic: str,
        way: _Way,
        counters: Counters,
        wanted: _Wanted,
    ) -> TopicColumns:
        known = self.types(recording, topic) or {}
        if not wanted.fields <= known.keys():
            raise UnfitError  # all was forgotten meanwhile, and the recording is another one
        types = {path: known[path] for path in wanted.fields}
        columns = way.load(types, wanted.ordered, counters)
        if len(columns) != recording.messages_of(topic) or columns.fields.keys() != wanted.fields:
            raise UnfitError
        return columns

    def _question(self, recording: RecordingEntry, topic: str) -> Query:
        """What asks for all messages of a topic of a recording."""
        assert recording.span is not None
        first, last = recording.span
        query = self._store.query([topic], [recording.id])
        if last + 1 < TIME_LIMIT:
            # The documents of other recordings need not be looked at.
            query = query.between(f"{first}ns", f"{last + 1}ns")
        return query

    def _keep(self, found: Mapping[tuple[str, str], TopicColumns], generation: int) -> None:
        """Keep these, and of the others those that were used last, as many as have room."""
        with self._lock:
            if generation != self._generation:
                return
            self._known.clear()
            for key, columns in found.items():
                self._kept[key] = columns
                self._kept.move_to_end(key)
            size = sum(columns.nbytes for columns in self._kept.values())
            while size > self.most_bytes:
                size -= self._kept.popitem(last=False)[1].nbytes

    def _lanes(self, recording: RecordingEntry, topic: str) -> list[Lane]:
        return [lane for lane in self._store.lanes(recording) if lane.channel.topic == topic]


def cost_s(messages: float, *, windows: int = 1, as_rows: bool = False) -> float:
    """What asking MongoDB costs, about, seconds.

    Args:
        messages: Index documents that it looks at.
        windows: Ranges of time that it is asked about.
        as_rows: Whether the documents are sent, not counted.
    """
    return _QUESTION_S * (1 + windows / 14) + messages * (_DOCUMENT_S if as_rows else _LOOK_S)


def _from_segments(
    question: Callable[[], Query], types: Mapping[str, str], _: object, counters: Counters
) -> TopicColumns:
    """Columns out of payloads."""
    query = question()
    plan = query.plan()
    parts: list[tuple[NDArray[np.int64], NDArray[np.int64], dict[str, Single]]] = []
    try:
        for piece in Sweep(plan, query.store.segment).unordered():
            for lane, rows in rows_by_channel(piece.batch.channel):
                batch, seq = piece.batch.take(rows), piece.seq[rows]
                decoded = plan.lanes[lane].codec.columns(
                    batch.buffer, batch.offset, batch.length, types.keys()
                )
                if decoded.unreadable:
                    raise UnfitError
                parts.append((batch.log_time, seq, singles(decoded.records, types)))
    except SegmentError as error:
        raise UnfitError from error  # the index has what is damaged here
    counters.bytes_read += query.counters.bytes_read
    counters.chunks_read += query.counters.chunks_read
    return _joined(parts)


def _from_index(
    question: Callable[[], Query], types: Mapping[str, str], _: object, counters: Counters
) -> TopicColumns:
    """Columns out of index documents."""
    query = question()
    projection = {"_id": 1, **dict.fromkeys(types, 1)}
    (topic,) = query.topics
    parts = []
    try:
        for raw, _, _ in query.thinned_documents(topic, projection):
            found = records_from_bson(raw, types)
            if len(found) > 1:
                raise UnfitError  # some messages lack a field
            for part in found:
                fields = singles(part.records, types)
                parts.append((part.reference.t, part.reference.seq, fields))
    except StoreError as error:
        raise UnfitError from error
    counters.documents_read += query.counters.documents_read
    return _joined(parts)


def _joined(
    parts: Sequence[tuple[NDArray[np.int64], NDArray[np.int64], dict[str, Single]]],
) -> TopicColumns:
    if not parts:
        raise UnfitError
    times, seqs, columns = zip(*parts, strict=True)
    log_time, seq = np.concatenate(times), np.concatenate(seqs)
    fields = {path: concatenate([part[path] for part in columns]) for path in columns[0]}
    return in_order(log_time, seq, fields)


def _is_small(stats: ChannelStats) -> bool:
    return is_small(stats.payload_bytes, stats.messages)
