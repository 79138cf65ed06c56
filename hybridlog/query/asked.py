"""Facts about a question that need no message: its channels, fields, times."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from hybridlog.query.counters import Counters
from hybridlog.query.planner import Planner

if TYPE_CHECKING:
    from hybridlog.query.query import Query
    from hybridlog.query.question import RecordedChannel, Span


def narrowed(query: Query, *topics: str) -> Query:
    """The same question about one or some of its topics, by their full names.

    If the question is about several recordings, tables of each topic name them.
    """
    session, question = query.session, query.question
    several = question.names_recording or len(session.chosen(question)) > 1
    names, chosen = session.having(topics, question.recordings)
    question = replace(question, topics=names, recordings=chosen, names_recording=several)
    return type(query)(query.source, question, query.conditions)


def channels_of(query: Query) -> list[RecordedChannel]:
    """Every channel of a question."""
    return Planner(query.session, query.question, query.counters).channels()


def field_types(query: Query) -> dict[str, str] | None:
    """Paths that can be queried and their types; None when a topic has no fixed fields."""
    return query.session.field_types(query.topics, query.question.recordings)


def spans_of(query: Query) -> dict[str, Span]:
    """Log time `[begin, end)` of the messages of each recording, ns; by id, oldest first.

    It is known without reading messages: those at its ends may not satisfy the predicate,
    or a range of another clock.
    """
    found: dict[str, Span] = {}
    for part in Planner(query.session, query.question, Counters()).split():
        extent = part.extent
        if extent is not None:
            low, high = found.get(part.recording.id, extent)
            found[part.recording.id] = min(low, extent[0]), max(high, extent[1])
    return found
