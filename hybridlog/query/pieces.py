"""Parts of a question: each recording, each mark, or each interval in which a predicate holds."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

from hybridlog.query.predicate.parser import is_filter
from hybridlog.query.question import Question
from hybridlog.query.topics import split_topic
from hybridlog.wording import file_name
from hybridlog_storage.errors import UsageError
from hybridlog_storage.manifest import free_name

if TYPE_CHECKING:
    from hybridlog.query.query import Query


class Piece(NamedTuple):
    """A part of a question, with the name of its recording, number and text: `run-002-docking`."""

    name: str
    query: Query


def pieces(query: Query, how: str) -> Iterator[Piece]:
    """The parts of a question, in the order of recordings and times.

    `how` is `recording`, `mark`, or a predicate, with `TOPIC: ` in front unless there is one topic.
    """
    if how == "recording":
        names = _files_of(query)
        for one in query.source.now().summaries_of(query.question):
            yield Piece(names[one.id], query.in_recording(one.id))
        return
    if how == "mark":
        yield from _of_intervals(query, _marks(query))
        return
    if ": " in how and not is_filter(how):
        topic, how = split_topic(how)
        question = query.source.now().question([topic], query.recordings)
    elif len(query.topics) != 1:
        raise UsageError("Name the topic of the predicate: 'TOPIC: PREDICATE'.")
    else:
        question = Question(query.topics, query.recordings)
    held = type(query)(query.source.now(), question).where(how).intervals()
    yield from _of_intervals(query, ((one.recording, one.begin_ns, one.end_ns, "") for one in held))


def _marks(query: Query) -> Iterator[tuple[str, int, int, str]]:
    """Marks as recording, begin, end and text.

    A mark of a moment lasts until the next one of a moment, or to the end of the recording.
    """
    from hybridlog.query.answers.interval_queries import marks_in

    ends = {one.id: one.extent[1] for one in query.source.now().summaries_of(query.question)}
    found = sorted(marks_in(query.source.now(), query.recordings))
    for place, one in enumerate(found):
        moments = (
            later.begin
            for later in found[place + 1 :]
            if later.recording == one.recording and later.end is None and later.begin > one.begin
        )
        end = next(moments, ends[one.recording]) if one.end is None else one.end
        yield one.recording, one.begin, end, one.text


def _files_of(query: Query) -> dict[str, str]:
    """A name of a file for each recording, by its id."""
    found: dict[str, str] = {}
    taken: set[str] = set()
    for one in query.source.now().summaries_of(query.question):
        found[one.id] = free_name(file_name(one.name), taken)
        taken.add(found[one.id])
    return found


def _of_intervals(query: Query, rows: Iterable[tuple[str, int, int, str]]) -> Iterator[Piece]:
    import numpy as np

    from hybridlog.query.intervals import Intervals

    names = _files_of(query)
    number = dict.fromkeys(names, 0)
    for recording, begin, end, text in rows:
        number[recording] += 1
        words: Sequence[str] = (names[recording], f"{number[recording]:03d}")
        name = "-".join([*words, file_name(text)] if text.strip() else words)
        one = query.in_recording(recording)
        if query.question.is_unbounded:
            one = one.between(begin, end)  # with latched messages from before
        else:
            span = np.array([[begin, end, 0]], np.int64)
            one = one.during(Intervals([(recording, span)]))
        yield Piece(name, one)
