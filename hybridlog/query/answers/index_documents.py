"""Index documents as MongoDB holds them, in the order of the messages.

In a store without MongoDB, they are made of the messages.
"""

from __future__ import annotations

import heapq
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import TYPE_CHECKING, Any

import bson
import numpy as np

from hybridlog.index.indexing import ChunkIndexer
from hybridlog.query.chunk_scan import ChunkScan
from hybridlog.query.index_reader import without_documents
from hybridlog.query.planner import Planner
from hybridlog_storage.errors import ConnectionLostError, DatabaseError
from hybridlog_storage.mongo.index_columns import KeyColumns
from hybridlog_storage.mongo.index_documents import KEY_BYTES
from hybridlog_storage.segments.chunk import StoredChunk

if TYPE_CHECKING:
    from hybridlog.query.chunk_scan import ChunkTask
    from hybridlog.query.counters import Counters
    from hybridlog.query.question import Part, Question
    from hybridlog.session import Session

Document = dict[str, Any]


def index_documents(session: Session, question: Question, counters: Counters) -> Iterator[Document]:
    """The index documents of the answer to a question.

    Raises:
        DatabaseError: the predicate is a MongoDB filter, and MongoDB is unavailable.
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
    missing = next((part.topic for part in parts if not part.is_indexed), None)
    if missing is not None:
        raise without_documents(missing)
    try:
        planner.index.connect(parts)
    except DatabaseError:
        if not session.connection.has_none or any(part.needs_index for part in parts):
            raise
        yield from _made(planner, parts)
        return
    counters.unindexed = planner.count_unindexed(parts)
    by_topic: dict[str, list[Part]] = defaultdict(list)
    for part in parts:
        by_topic[part.topic].append(part)
    streams = [stream for of_topic in by_topic.values() for stream in _of_topic(planner, of_topic)]
    # Keys are ordered by log time, recording and arrival, over all topics.
    yield from heapq.merge(*streams, key=_key, reverse=question.reverse)


def _made(planner: Planner, parts: Sequence[Part]) -> Iterator[tuple[str, Document]]:
    """All matching documents with their topics, in order, made of the messages."""
    plan = planner.plan(parts)
    channels = {index: one.channel for index, one in enumerate(plan.channels)}
    indexers = {part.recording.id: ChunkIndexer(part.recording.id) for part in parts}
    waiting: list[tuple[str, Document]] = []
    for task, run, following in ChunkScan(plan, planner.session.segment).loaded():
        if len(run.batch):
            at = task.chunk
            chunk = StoredChunk(
                segment=at.segment,
                number=at.number,
                offset=at.place.offset,
                length=at.place.length,
                trailer=at.place.trailer,
                crc=0,
                trailer_crc=0,
                batch=run.batch,
                seq=run.seq,
                compressed_size=0,
            )
            found, _ = indexers[task.scan.recording.id].documents_of([chunk], channels)
            for topic, tables in found:
                raw = b"".join(table.tobytes() for table in tables)
                waiting += [(topic, document) for document in bson.decode_all(raw)]
            waiting.sort(key=_key, reverse=plan.reverse)
        yield from _before(waiting, following, reverse=plan.reverse)


def _before(
    waiting: list[tuple[str, Document]], following: ChunkTask | None, *, reverse: bool
) -> Iterator[tuple[str, Document]]:
    """Take out the documents that none of the following chunks can precede."""
    ready = len(waiting)
    if following is not None:
        times = (document["_meta"]["t"] for _, document in waiting)
        first, last = following.chunk.first, following.chunk.last
        is_later = (t <= last if reverse else t >= first for t in times)
        ready = next((row for row, later in enumerate(is_later) if later), ready)
    yield from waiting[:ready]
    del waiting[:ready]


def _key(pair: tuple[str, Document]) -> bytes:
    """The key of a document, without the prefix that it has among those of other topics."""
    return bytes(pair[1]["_id"][-KEY_BYTES:])


def _of_topic(planner: Planner, parts: Sequence[Part]) -> list[Iterator[tuple[str, Document]]]:
    """Streams of the documents of one topic that match, each in order."""
    reverse = planner.question.reverse

    def read(stream: Iterator[bytes]) -> Iterator[tuple[str, Document]]:
        for raw in stream:
            documents = bson.decode_all(raw)
            planner.counters.documents_read += len(documents)
            yield from ((parts[0].topic, document) for document in documents)

    if planner.question.predicate is None:
        return [read(stream) for stream in planner.index.documents(parts, reverse=reverse)]
    keys = _keys(planner, parts)
    return [read(planner.index.documents_with(parts, keys, reverse=reverse))]


def _keys(planner: Planner, parts: Sequence[Part]) -> KeyColumns:
    """The keys of the matching messages of one topic, in order; columns or messages decide."""
    empty = np.empty(0, np.int64), np.empty(0, np.uint64), np.empty(0, np.int64)
    found = [empty]
    for part in parts:
        own = np.uint64(int(part.recording.key, 16))
        for outcomes in planner.outcomes(part):
            time = outcomes.log_time[outcomes.holds]
            found.append((time, np.full(len(time), own), outcomes.seq[outcomes.holds]))
    time, recording, seq = (np.concatenate(columns) for columns in zip(*found, strict=True))
    order = np.lexsort((seq, recording, time))
    return KeyColumns(time[order], recording[order], seq[order])
