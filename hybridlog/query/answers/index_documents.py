"""Index documents as MongoDB holds them, in the order of the messages."""

from __future__ import annotations

import heapq
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from typing import TYPE_CHECKING, Any

import bson

from hybridlog.query.engines.mongo import Mongo
from hybridlog.query.planner import Planner
from hybridlog_storage.errors import ConnectionLostError, TopicError
from hybridlog_storage.index_documents import KEY_BYTES

if TYPE_CHECKING:
    from hybridlog.query.counters import Counters
    from hybridlog.query.question import Part, Question
    from hybridlog.session import Session

Document = dict[str, Any]


def index_documents(session: Session, question: Question, counters: Counters) -> Iterator[Document]:
    """The index documents of the answer to a question.

    Raises:
        DatabaseError: MongoDB is unavailable.
        IndexChangedError: another process changes the index.
        TopicError: a topic was recorded without index documents.
    """
    seen: Counter[str] = Counter()
    given = 0
    for topic, document in _resumed(session, question, counters):
        if question.limit is not None and given >= question.limit:
            return
        seen[topic] += 1
        if (seen[topic] - 1) % question.every == 0:
            given += 1
            yield document


def _resumed(
    session: Session, question: Question, counters: Counters
) -> Iterator[tuple[str, Document]]:
    """All matching documents; if the connection is lost, a new one goes on where it was."""
    done = 0
    try:
        for found in _matching(session, question, counters):
            done += 1
            yield found
    except ConnectionLostError:
        yield from islice(_matching(session, question, counters), done, None)


def _matching(
    session: Session, question: Question, counters: Counters
) -> Iterator[tuple[str, Document]]:
    """All matching documents with their topics, in order."""
    planner = Planner(session, question, counters)
    parts = planner.parts()
    missing = sorted({part.topic for part in parts if not part.is_indexed})
    if missing:
        raise TopicError(
            f"{missing[0]} has no index documents: it was recorded with --no-index. Ask for its "
            "messages or tables."
        )
    mongo = Mongo(session, counters, lambda: parts)
    if not all(mongo.reaches(part) for part in parts[:1]):
        session.database_for("Reading index documents")
    counters.unindexed = planner.count_unindexed(parts)
    by_topic: dict[str, list[Part]] = defaultdict(list)
    for part in parts:
        by_topic[part.topic].append(part)
    streams = [
        stream
        for of_topic in by_topic.values()
        for stream in _of_topic(planner, mongo, of_topic, reverse=question.reverse)
    ]
    # Keys are ordered by log time, recording and arrival, over all topics.
    return heapq.merge(*streams, key=_key, reverse=question.reverse)


def _key(pair: tuple[str, Document]) -> bytes:
    """The key of a document, without the prefix that it has among those of other topics."""
    return bytes(pair[1]["_id"][-KEY_BYTES:])


def _of_topic(
    planner: Planner, mongo: Mongo, parts: Sequence[Part], *, reverse: bool
) -> list[Iterator[tuple[str, Document]]]:
    """Streams of the documents of one topic that match, each in order."""
    matching = _Matching(planner, mongo, parts)

    def read(stream: Iterator[bytes]) -> Iterator[tuple[str, Document]]:
        for raw in stream:
            documents = bson.decode_all(raw)
            planner.counters.documents_read += len(documents)
            yield from ((parts[0].topic, d) for d in documents if matching.has(d["_meta"]))

    return [read(stream) for stream in mongo.documents(parts, reverse=reverse)]


class _Matching:
    """Knows which of the documents that MongoDB finds match, where it cannot decide."""

    def __init__(self, planner: Planner, mongo: Mongo, parts: Sequence[Part]) -> None:
        self._planner = planner
        self._unsure = {p.recording.key: p for p in parts if not mongo.filter_of(p).is_exact}
        self._found: dict[str, set[tuple[int, int]]] = {}

    def has(self, meta: Mapping[str, Any]) -> bool:
        """True if a document matches, by its `_meta`."""
        key = meta["rec"]
        part = self._unsure.get(key)
        if part is None:
            return True
        if key not in self._found:
            found = self._found[key] = set()
            for outcomes in self._planner.outcomes(part):
                rows = outcomes.holds
                found.update(
                    zip(outcomes.log_time[rows].tolist(), outcomes.seq[rows].tolist(), strict=True)
                )
        return (meta["t"], meta["seq"]) in self._found[key]
