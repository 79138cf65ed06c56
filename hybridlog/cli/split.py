"""Splits an answer over several files: `--split-by recording|mark|PREDICATE`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import click

from hybridlog.cli import output
from hybridlog.cli.answers import check_room
from hybridlog_storage.errors import TimeError, UsageError

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog.query.query import Query
    from hybridlog.store import Store

split_by = click.option(
    "--split-by",
    "split",
    metavar="HOW",
    help="A file for each `recording`, each `mark`, or each interval in which a predicate holds: "
    "'odom: twist.twist.linear.x > 0.1'. Their names follow that of the output.",
)


class Piece(NamedTuple):
    """A part of an answer.

    Attributes:
        name: What its file's name has in addition.
        query: The question about it.
    """

    name: str
    query: Query

    def path(self, whole: Path) -> Path:
        """Its file or directory, beside that of the whole answer."""
        return whole.with_name(f"{whole.stem}-{self.name}{whole.suffix}")


def pieces(
    store: Store, query: Query, how: str, target: Path, *, force: bool, is_directory: bool | None
) -> Iterator[tuple[Path, Query]]:
    """The parts of an answer that have messages, and where to write each; says which have none.

    Args:
        store: The store.
        query: The whole question.
        how: `recording`, `mark`, or a predicate, with `TOPIC: ` in front or about the one topic.
        target: The output.
        force: Overwrite files.
        is_directory: Each part is a directory with a file a message; None if the writer checks
            its files.

    Raises:
        UsageError: A predicate of no topic, or a file exists.
        WhereError: It cannot be parsed, or does not fit the fields.
        TopicError: There is no such topic.
    """
    found = [piece for piece in _pieces(store, query, how) if _has_messages(piece)]
    if not found:
        output.note("No messages, so no file.")
    for piece in found:
        path = piece.path(target)
        if is_directory is not None:
            check_room(path, force=force, is_directory=is_directory)
    for piece in found:
        yield piece.path(target), piece.query


def _has_messages(piece: Piece) -> bool:
    try:
        count = piece.query.count()
    except TimeError:  # the range is outside
        count = 0
    if not count:
        output.note(f"{piece.name}: no messages, so no file.")
    return count > 0


def _pieces(store: Store, query: Query, how: str) -> Iterator[Piece]:
    if how == "recording":
        for one in query.summaries():
            yield Piece(one.label, query.in_recording(one.id))
        return
    if how == "mark":
        yield from _of_intervals(query, _marks(query), "mark")
        return
    events = query
    if ": " in how:
        from hybridlog.query.topics import split_topic

        topic, how = split_topic(how)
        events = store.recordings(list(query.recordings)).topic(topic)
    elif len(query.topics) != 1:
        raise UsageError("Name the topic of the predicate: --split-by 'TOPIC: PREDICATE'.")
    else:
        events = store.recordings(list(query.recordings)).topic(*query.topics)
    held = events.where(how).intervals()
    rows = ((one.recording, one.begin_ns, one.end_ns, "") for one in held)
    yield from _of_intervals(query, rows, "interval")


def _marks(query: Query) -> Iterator[tuple[str, int, int, str]]:
    """Marks as recording, begin, end and text.

    A mark of a moment lasts until the next one of a moment, or to the end of the recording.
    """
    from hybridlog.query.answers.marks import marks_in
    from hybridlog.query.counters import Counters

    ends = {one.id: one.extent[1] for one in query.summaries()}
    found = sorted(marks_in(query.session, query.recordings, Counters()))
    for place, one in enumerate(found):
        moments = (
            later.begin
            for later in found[place + 1 :]
            if later.recording == one.recording and later.end is None and later.begin > one.begin
        )
        end = next(moments, ends[one.recording]) if one.end is None else one.end
        yield one.recording, one.begin, end, one.text


def _of_intervals(
    query: Query, rows: Iterable[tuple[str, int, int, str]], noun: str
) -> Iterator[Piece]:
    import numpy as np

    from hybridlog.query.intervals import Intervals
    from hybridlog_storage.disk.directory import label_of

    labels = {one.id: one.label for one in query.summaries()}
    number = dict.fromkeys(labels, 0)
    for recording, begin, end, text in rows:
        number[recording] += 1
        words: Sequence[str] = (labels[recording], f"{number[recording]:03d}")
        name = "-".join([*words, label_of(text)] if text.strip() else words)
        one = query.in_recording(recording)
        if query.question.is_unbounded:
            one = one.between(begin, end)  # with latched messages from before
        else:
            span = np.array([[begin, end, 0]], np.int64)
            one = one.during(Intervals.of([(recording, span)]))
        yield Piece(name, one)
    if not any(number.values()):
        output.note(f"No {noun}.")
