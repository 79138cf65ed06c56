"""Answers from the index in MongoDB."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from hybridlog.query.chunk_scan import ChunkKey, RowSelection
from hybridlog.query.engines.base import Need, Outcomes, Values
from hybridlog.query.predicate.to_mongo import MongoFilter, to_mongo
from hybridlog.query.predicate.tree import And
from hybridlog.schema.column import STAMP
from hybridlog.snapshot import UNFINISHED
from hybridlog_storage.errors import DatabaseError, IndexChangedError
from hybridlog_storage.index_columns import KEY, REFERENCE, key_columns, reference_columns
from hybridlog_storage.stopping import check_wanted
from hybridlog_storage.times import END, placed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.guarded import GuardedIndex
    from hybridlog.query.chunk_scan import ChunkTask
    from hybridlog.query.counters import Counters
    from hybridlog.query.question import Part, Span
    from hybridlog.session import Session
    from hybridlog_storage.index_columns import KeyColumns
    from hybridlog_storage.topic_places import TopicPlace

_QUESTION_S = 0.4e-3  # seconds for a query to MongoDB
_LOOK_S = 0.7e-6  # seconds to examine a document
_DOCUMENT_S = 4e-6  # seconds to send a document
_WINDOWS_A_QUESTION = 14
_BATCH = 50_000
_DOCUMENTS = 10_000
_AHEAD = 200_000  # messages whose keys are read at once
_MOST_APART = 100  # ranges of log time: as many as one command asks for
_Filter = dict[str, object]
_READABLE: _Filter = {"_meta.error": {"$exists": False}}
_WITHOUT_FIELDS: _Filter = {"_meta.error": {"$exists": True}}


class Mongo:
    """Finds index documents. Fields come from the messages, which hold the exact values.

    Args:
        session: The open store.
        counters: Count the documents that are read.
        together: The parts of the question, about which the index is asked at once.
    """

    def __init__(
        self, session: Session, counters: Counters, together: Callable[[], Sequence[Part]] = tuple
    ) -> None:
        self._session = session
        self._counters = counters
        self._together = together
        self._undecided: dict[Part, int] = {}
        self._ahead: dict[Part, list[Outcomes]] = {}
        self._placed: dict[str, TopicPlace] = {}
        self._is_known = False
        self._is_away = False

    def forget(self) -> None:
        """Forget what the index has said: after a new connection it may be another one."""
        for found in (self._undecided, self._ahead, self._placed):
            found.clear()
        self._is_known = self._is_away = False

    def cost(self, part: Part, need: Need, fields: Collection[str] | None = ()) -> float | None:
        """By the number of documents looked at; None without MongoDB, or if it cannot tell.

        The index of a running recording is of another moment than its segments.
        """
        # Documents do not tell the channels of a topic apart, so none may be blind.
        is_answered = part.is_indexed and not part.blind and not _is_older(part)
        is_open = part.recording.status in UNFINISHED
        if is_open:
            is_answered &= part.needs_index
        if need is Need.VALUES or self._is_away or not is_answered:
            return None
        if not self.reaches(part):
            return None
        try:
            is_listed = is_open or self._place(part).is_listed  # without documents yet
            if not is_listed or (need is not Need.SELECTION and self.undecided(part)):
                return None
        except IndexChangedError:
            return None
        except DatabaseError:
            self._is_away = True  # not to wait for it once for each part
            return None
        windows = 1 if part.windows is None else len(part.windows)
        each = _LOOK_S if need is Need.COUNT else _LOOK_S + _DOCUMENT_S
        return _QUESTION_S * (1 + windows / _WINDOWS_A_QUESTION) + (
            each * part.messages * part.share
        )

    def reaches(self, part: Part) -> bool:
        """True if MongoDB answers; the index then has the recordings of the question."""
        others = self._together
        database = self._session.database_about(
            part.recording, lambda: (other.recording for other in others())
        )
        return database is not None

    def filter_of(self, part: Part) -> MongoFilter:
        """The predicate of a part as a MongoDB filter."""
        if part.predicate is None:
            return to_mongo(And(()))
        found = to_mongo(part.predicate.root, part.field_types)
        if not _lacks_fields(part):
            return found
        certain = joined(_READABLE, found.certain)
        if part.predicate.is_opaque:
            return MongoFilter(joined(_READABLE, found.filter), certain, found.is_exact)
        # Fields that were too large for a document are in the message, which decides.
        possible: _Filter = {"$or": [joined(_READABLE, found.filter), _WITHOUT_FIELDS]}
        return MongoFilter(possible, certain, is_exact=False)

    def count_unasked(self, part: Part) -> int:
        """Number of documents without fields, of which a filter for MongoDB cannot be asked.

        Raises:
            DatabaseError: MongoDB is unavailable.
            IndexChangedError: another process changes the index.
        """
        asked = [question for question, _ in self._questions([part], lambda _: _WITHOUT_FIELDS)]
        return sum(self._index([part]).count_each(asked))

    def undecided(self, part: Part) -> int:
        """Number of documents that cannot decide whether their message matches.

        Long arrays are summaries there, some integers are rounded, and MongoDB does not
        search with patterns. Its candidates may be more than the matches.

        Raises:
            DatabaseError: MongoDB is unavailable.
            IndexChangedError: another process changes the index.
        """
        if self.filter_of(part).is_exact:
            return 0
        if part not in self._undecided:
            others = [p for p in self._together() if p.topic == part.topic and p is not part]
            try:
                self._ask_undecided([part, *others])
            except IndexChangedError:
                self._ask_undecided([part])
        return self._undecided[part]

    def _ask_undecided(self, parts: Sequence[Part]) -> None:
        """Ask about parts of one topic, with one question."""

        def unsure(found: MongoFilter) -> _Filter:
            return {"$and": [found.filter, {"$nor": [found.certain]}]}

        open_parts = [p for p in parts if not self.filter_of(p).is_exact]
        asked = [question for question, _ in self._questions(open_parts, unsure)]
        found = self._index(open_parts).count_by(asked, "_meta.rec")
        self._undecided.update((p, found.get(p.recording.key, 0)) for p in open_parts)

    def count(self, parts: Sequence[Part]) -> int:
        """Number of documents that match.

        Raises:
            DatabaseError: MongoDB is unavailable.
            IndexChangedError: another process changes the index.
        """
        # Where it decides, both filters find the same; this one also if a document comes now.
        asked = [question for question, _ in self._questions(parts, lambda f: f.certain)]
        return sum(self._index(parts).count_each(asked))

    def counts(self, parts: Sequence[Part]) -> Iterator[tuple[Part, int]]:
        """The number of documents that match in each part, with a question for each topic.

        Raises:
            DatabaseError: MongoDB is unavailable.
            IndexChangedError: another process changes the index.
        """
        by_topic: dict[str, list[Part]] = defaultdict(list)
        for part in parts:
            by_topic[part.topic].append(part)
        for group in by_topic.values():
            asked = [question for question, _ in self._questions(group, lambda f: f.filter)]
            found = self._index(group).count_by(asked, "_meta.rec")
            yield from ((part, found.get(part.recording.key, 0)) for part in group)

    def outcomes(self, part: Part) -> Iterator[Outcomes]:
        """Keys of the matching documents merged with keys of the others."""
        if part in self._ahead or self._look_ahead(part):
            yield from self._ahead.pop(part)
            return
        own = self.filter_of(part).certain
        place = self._place(part)
        for condition, _ in conditions(part, place):
            yes = self._keys(part, place, joined(condition, own))
            no: Iterator[KeyColumns] = iter(())
            if own:
                no = self._keys(part, place, joined(condition, {"$nor": [own]}))
            yield from _merged(yes, no)

    def _look_ahead(self, part: Part) -> bool:
        """Ask about this part and the following ones at once, if that is more than one."""
        together = self._together()
        place = next((i for i, other in enumerate(together) if other is part), len(together))
        group: list[Part] = []
        messages = 0.0
        for other in together[place:]:
            if other.topic == part.topic:
                messages += other.messages * other.share
                if messages > _AHEAD:
                    break
                group.append(other)
        if len(group) < 2:
            return False
        yes = self._all_keys(group, lambda found: found.certain)
        no = yes.take(slice(0))
        if self.filter_of(part).certain:
            no = self._all_keys(group, lambda found: {"$nor": [found.certain]})
        for one in group:
            both = (iter([k] if len(k) else []) for k in (_keys_in(yes, one), _keys_in(no, one)))
            self._ahead[one] = [*_merged(*both)]
        return True

    def _all_keys(self, parts: Sequence[Part], of: Callable[[MongoFilter], _Filter]) -> KeyColumns:
        """Keys of the documents of parts of one topic, by recording and in order."""
        asked = [query for (_, query), _ in self._questions(parts, of)]
        found = self._index(parts).find_each(self._place(parts[0]).collection, asked, KEY)
        keys = key_columns(b"".join(found))
        self._counters.documents_read += len(keys)
        order = np.lexsort((keys.seq, keys.time, keys.recording))
        keys = keys.take(order)
        # Parts may overlap.
        columns = (keys.recording, keys.time, keys.seq)
        is_new = np.any([column[1:] != column[:-1] for column in columns], axis=0)
        return keys.take(np.flatnonzero(np.append(np.True_, is_new)) if len(keys) else slice(0))

    def values(self, part: Part, fields: Collection[str] | None) -> Iterator[Values]:
        """Not supported: `cost` returns None."""
        raise NotImplementedError

    def select(self, parts: Sequence[Part], tasks: Sequence[ChunkTask]) -> RowSelection:
        """References of the documents that match, or may match."""
        times: dict[str, list[int]] = defaultdict(list)
        for task in tasks:
            times[task.key[0]] += [task.first, task.last + 1]
        alike: dict[tuple[TopicPlace, str], list[Part]] = defaultdict(list)
        for part in parts:
            if part.recording.id in times:
                own = self.filter_of(part).filter
                alike[self._place(part), repr(own)].append(part)
        index = self._index([part for group in alike.values() for part in group])
        wanted = {task.key for task in tasks}
        found: dict[ChunkKey, list[NDArray[np.int64]]] = defaultdict(list)
        for (where, _), group in alike.items():
            spans = [(min(t), max(t)) for t in (times[part.recording.id] for part in group)]
            # More documents than those of the chunks may be found, but no others are used.
            asked = [
                joined(_chosen(where, span, own), self.filter_of(own[0]).filter)
                for span, own in self._ranges(group, spans)
            ]
            id_of = {int(part.recording.key, 16): part.recording.id for part in group}
            for raw in index.find_each(where.collection, asked, REFERENCE):
                reference = reference_columns(raw)
                self._counters.documents_read += len(reference)
                for (recording, *place), offsets in reference.by_chunk():
                    key = (id_of[recording], place[0], place[1])
                    if key in wanted:
                        found[key].append(offsets)
        return RowSelection({key: np.sort(np.concatenate(p)) for key, p in found.items()})

    def documents(self, parts: Sequence[Part], *, reverse: bool) -> list[Iterator[bytes]]:
        """Index documents of the candidates of some parts of one topic.

        Returns:
            Streams of many documents at a time, each in order.

        Raises:
            DatabaseError: MongoDB is unavailable.
        """
        order = -1 if reverse else 1
        questions = self._questions(parts, lambda f: f.filter, most=1)
        streams: list[list[tuple[str, _Filter]]] = []
        ends: list[int] = []
        for question, (begin, end) in sorted(questions, key=lambda asked: asked[1]):
            place = next((i for i, last in enumerate(ends) if last <= begin), len(ends))
            if place == len(ends):
                streams.append([])
                ends.append(end)
            streams[place].append(question)
            ends[place] = end

        def read(asked: Sequence[tuple[str, _Filter]]) -> Iterator[bytes]:
            for collection, query in asked[::order]:
                yield from self._index(parts).find_raw(
                    collection, query, sort=[("_id", order)], batch_size=_DOCUMENTS
                )

        return [read(asked) for asked in streams]

    def _questions(
        self,
        parts: Sequence[Part],
        of: Callable[[MongoFilter], _Filter],
        most: int | None = None,
    ) -> list[tuple[tuple[str, _Filter], Span]]:
        """Collections and filters that ask about each part once, with the log time of each.

        Parts that differ only in their recordings are asked about together, where nothing
        else lies between them.
        """
        alike: dict[tuple[TopicPlace, str, str, Span | None], list[tuple[Part, Span]]]
        alike = defaultdict(list)
        found: list[tuple[tuple[str, _Filter], Span]] = []
        for part in parts:
            place, own = self._place(part), of(self.filter_of(part))
            if part.windows is not None:
                for condition, span in conditions(part, place):
                    found.append(((place.collection, joined(condition, own)), span))
                continue
            span, bounds = _time_of(part)
            if span[0] < span[1]:
                alike[place, repr(own), part.clock, bounds].append((part, span))
        for (place, _, clock, bounds), group in alike.items():
            own = of(self.filter_of(group[0][0]))
            for span, there in self._ranges([p for p, _ in group], [s for _, s in group], most):
                condition = _chosen(place, span, there)
                if clock != "log" and bounds is not None:
                    condition.update(_on_clock(clock, bounds))
                found.append(((place.collection, joined(condition, own)), span))
        return found

    def _ranges(
        self, parts: Sequence[Part], spans: Sequence[Span], most: int | None = None
    ) -> list[tuple[Span, list[Part]]]:
        """Ranges of log time that hold the spans of some parts, with the parts of each.

        Spans are joined if they overlap, and if they are more than `most`, also across gaps in
        which no other recording lies: finding many documents in one range costs less than
        asking for many ranges.
        """
        if not parts:
            return []
        order = sorted(range(len(parts)), key=spans.__getitem__)
        ends = np.array([min(spans[i][1], END) for i in order[:-1]], np.int64)
        low = np.maximum.accumulate(ends)
        high = np.array([spans[i][0] for i in order[1:]], np.int64)
        is_apart = low < high
        if int(is_apart.sum()) >= (_MOST_APART if most is None else most):
            first, end = self._session.snapshot().others({part.recording.id for part in parts})
            before = np.searchsorted(np.sort(first), high, "left")
            is_apart &= before > np.searchsorted(np.sort(end), low, "right")
        steps = [0, *(np.flatnonzero(is_apart) + 1).tolist(), len(order)]
        groups = [order[begin:end] for begin, end in pairwise(steps)]
        return [
            (
                (spans[group[0]][0], max(spans[i][1] for i in group)),
                [parts[i] for i in group],
            )
            for group in groups
        ]

    def _place(self, part: Part) -> TopicPlace:
        """The place of the documents of a part; asked for all topics of the question at once.

        Raises:
            DatabaseError: MongoDB is unavailable.
        """
        if part.topic not in self._placed:
            topics = {part.topic, *(other.topic for other in self._together())}
            self._placed |= self._session.places("A predicate").of(topics)
        return self._placed[part.topic]

    def _index(self, parts: Iterable[Part]) -> GuardedIndex:
        entries = list({part.recording.id: part.recording for part in parts}.values())
        if not self._is_known:
            # The state of all recordings of the question is read at once.
            everything = [*entries, *(part.recording for part in self._together())]
            database = self._session.connected or self._session.database_for("A predicate")
            self._session.belief(database, {entry.key for entry in everything})
            self._is_known = True
        return self._session.index_for("A predicate", entries)

    def _keys(self, part: Part, place: TopicPlace, asked: _Filter) -> Iterator[KeyColumns]:
        """Keys of the documents that a filter finds, in order; no batch is empty."""
        found = self._index([part]).find_raw(
            place.collection, asked, KEY, sort=[("_id", 1)], batch_size=_BATCH
        )
        for raw in found:
            check_wanted()
            keys = key_columns(raw)
            self._counters.documents_read += len(keys)
            if len(keys):
                yield keys


def _lacks_fields(part: Part) -> bool:
    """True if documents of a part may have no fields: unreadable messages, or too large ones."""
    if part.predicate is None or not part.predicate.asks_fields:
        return False
    return part.recording.status == "open" or any(stats.unreadable for stats in part.stats)


def _is_older(part: Part) -> bool:
    """True if the index is older than the package that reads the fields of the messages."""
    if part.predicate is None:
        return False
    return any(c.reason is not None and c.codec.indexed for c in part.channels)


def joined(condition: _Filter, predicate: Mapping[str, object]) -> _Filter:
    """Both filters joined by *and*."""
    return {"$and": [condition, dict(predicate)]} if predicate else condition


def conditions(part: Part, place: TopicPlace) -> Iterator[tuple[_Filter, Span]]:
    """The recording, topic and time of a part as filters, one for each window, in order."""
    recording: _Filter = {"_meta.rec": part.recording.key}
    if part.bounds is not None and part.clock != "log":
        recording.update(_on_clock(part.clock, part.bounds))
    for begin, end in part.log_windows.tolist():
        yield {**recording, **_between(place, (begin, end))}, (begin, end)


def _on_clock(clock: str, bounds: Span) -> _Filter:
    name = STAMP if clock == "header" else "_meta.pub"
    begin, end = bounds
    return {name: {"$gte": begin, "$lte" if end == END else "$lt": end}}


def _chosen(place: TopicPlace, span: Span, parts: Sequence[Part]) -> _Filter:
    """The recordings of some parts of a topic, in a range of log time."""
    keys = sorted(part.recording.key for part in parts)
    return {"_meta.rec": {"$in": keys} if len(keys) > 1 else keys[0], **_between(place, span)}


def _time_of(part: Part) -> tuple[Span, Span | None]:
    """The log time of a part without windows, and its bounds if they exclude messages.

    The log time is cut to that of its messages, where it is known.
    """
    low, high = (0, END) if part.bounds is None else part.bounds
    first, end = 0, END
    if part.recording.status != "open":
        first, end = part.span or (0, 0)
    if part.bounds is None:
        return (first, end), None
    if part.clock != "log":
        return (first, end), part.bounds
    is_whole = low <= first and end <= high
    return (max(first, low), min(end, high)), None if is_whole else part.bounds


def _between(place: TopicPlace, span: Span) -> _Filter:
    begin, end = span
    if begin <= 0 and end >= END:
        return place.documents()
    return place.documents(begin, end if end < END else None)


def _keys_in(keys: KeyColumns, part: Part) -> KeyColumns:
    """The keys of one part, of those of several recordings in order."""
    windows = part.log_windows
    if not len(windows):
        return keys.take(slice(0))
    recording = np.uint64(int(part.recording.key, 16))
    low, high = (
        int(np.searchsorted(keys.recording, recording, side)) for side in ("left", "right")
    )
    own = placed(keys.time[low:high])
    begin, end = np.searchsorted(own, [windows[0, 0], windows[-1, 1]])
    return keys.take(slice(low + int(begin), low + int(end)))


def _merged(yes: Iterator[KeyColumns], no: Iterator[KeyColumns]) -> Iterator[Outcomes]:
    """Two ordered streams of keys as one, with the stream of each key."""
    left, right = next(yes, None), next(no, None)
    while left is not None and right is not None:
        # No later key of either stream precedes the nearer end.
        end = min((int(k.time[-1]), int(k.seq[-1])) for k in (left, right))
        here, there = left.place_after(*end), right.place_after(*end)
        time = np.concatenate([left.time[:here], right.time[:there]])
        seq = np.concatenate([left.seq[:here], right.seq[:there]])
        order = np.lexsort((seq, time))
        yield Outcomes(time[order], seq[order], order < here)
        left = left.take(slice(here, None)) if here < len(left) else next(yes, None)
        right = right.take(slice(there, None)) if there < len(right) else next(no, None)
    while left is not None:
        yield Outcomes(left.time, left.seq, np.ones(len(left), np.bool_))
        left = next(yes, None)
    while right is not None:
        yield Outcomes(right.time, right.seq, np.zeros(len(right), np.bool_))
        right = next(no, None)
