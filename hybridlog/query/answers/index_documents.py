"""Index documents as MongoDB holds them, in the order of the messages."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import bson

from hybridlog.query.engines.mongo import Mongo
from hybridlog.query.planner import Planner

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
    """
    session.database_for("Reading index documents")
    planner = Planner(session, question, counters)
    mongo = Mongo(session, counters)
    streams = [_of_part(planner, mongo, part, reverse=question.reverse) for part in planner.parts()]
    # Keys are ordered by log time, recording and arrival, over all topics.
    merged = heapq.merge(*streams, key=lambda pair: pair[1]["_id"], reverse=question.reverse)
    seen: Counter[str] = Counter()
    given = 0
    for topic, document in merged:
        if question.limit is not None and given >= question.limit:
            return
        seen[topic] += 1
        if (seen[topic] - 1) % question.every == 0:
            given += 1
            yield document


def _of_part(
    planner: Planner, mongo: Mongo, part: Part, *, reverse: bool
) -> Iterator[tuple[str, Document]]:
    matching: set[tuple[int, int]] | None = None
    if not mongo.filter_of(part).is_exact:
        matching = set()
        for found in planner.outcomes(part):
            rows = found.holds
            matching.update(
                zip(found.log_time[rows].tolist(), found.seq[rows].tolist(), strict=True)
            )
    for raw in mongo.documents(part, reverse=reverse):
        documents = bson.decode_all(raw)
        planner.counters.documents_read += len(documents)
        for document in documents:
            meta = document["_meta"]
            if matching is None or (meta["t"], meta["seq"]) in matching:
                yield part.topic, document
