"""Remarks on a question: fields and stamps, and likely causes of an empty answer."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator
from itertools import islice
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace

from hybridlog.query.planner import Planner
from hybridlog.query.predicate.tree import is_meta
from hybridlog.query.question import Question, field_types
from hybridlog.query.ranges import RangeResolver
from hybridlog.query.times import format_time
from hybridlog.snapshot import UNFINISHED
from hybridlog.wording import like, meant

if TYPE_CHECKING:
    from hybridlog.query.question import RecordedChannel, Span
    from hybridlog.session import Session

_MAX_RECORDINGS = 100  # recordings looked at
_APART_NS = 86_400 * 10**9  # header stamps and log times this far apart have other epochs


def remarks(session: Session, question: Question, *, is_empty: bool) -> Iterator[str]:
    """Sentences about an answer, for people; its `Completeness` has those about what it lacks.

    Args:
        session: The open store.
        question: The question.
        is_empty: The answer has no messages or intervals.
    """
    if question.clock == "header" and question.bounds is not None:
        yield from _about_stamps(session, question)
    yield from _missing_fields(session, question, is_empty=is_empty)
    yield from _missing_columns(session, question)
    if is_empty and question.limit != 0:
        yield from _causes(session, question)


def _about_stamps(session: Session, question: Question) -> Iterator[str]:
    """Header stamps of another epoch than the log times, and messages without a stamp."""
    is_noted = False
    missing = 0
    entries = map(session.entry_of, session.summaries_of(question)[:_MAX_RECORDINGS])
    topics = {*question.topics}
    for channel in (one for entry in entries for one in session.channels_of(entry, topics)):
        stats = channel.stats
        if channel.recording.is_decoded:
            missing += stats.messages - stats.stamped + stats.unset
        first, last = stats.first_stamp, stats.last_stamp
        if is_noted or first is None or last is None or stats.first is None or stats.last is None:
            continue
        if first < stats.first - _APART_NS or last > stats.last + _APART_NS:
            is_noted = True
            yield (
                f"Header stamps of {channel.channel.topic} are from {format_time(first)} to "
                f"{format_time(last)}, its log times from {format_time(stats.first)} to "
                f"{format_time(stats.last)}: times count by the header clock here."
            )
    if missing:
        are, have = ("message is", "it has") if missing == 1 else ("messages are", "they have")
        none = f"{have} no header stamp, or one of zero"
        yield f"{missing} {are} at no time of the header clock: {none}."


def _missing_fields(session: Session, question: Question, *, is_empty: bool) -> Iterator[str]:
    """Topics of whose messages the predicate asks for a field that they do not have."""
    if question.predicate is None:
        return
    paths = dict.fromkeys(
        condition.field.names
        for condition in question.predicate.conditions()
        if condition.operands and not is_meta(condition.field.path)
    )
    if not paths:
        return
    by_topic: dict[str, list[RecordedChannel]] = defaultdict(list)
    for channel in Planner(session, question).examples:
        by_topic[channel.channel.topic].append(channel)
    for topic, channels in by_topic.items():
        if not any(channel.codec.indexed for channel in channels):
            continue  # they have no fields at all
        known: Collection[str] | None = field_types(tuple(channels))
        if known is None and is_empty:
            known = _fields_in_tables(session, question, topic)
        for path in paths if known is not None else ():
            yield from _missing(topic, path, known or ())


def _missing_columns(session: Session, question: Question) -> Iterator[str]:
    """Fields that a table was asked for and no message has, where no definition fixes them."""
    if not question.fields or session.field_types(question.topics, question.recordings) is not None:
        return
    from hybridlog.frames.names import is_own

    found = [_fields_in_tables(session, question, topic) for topic in question.topics]
    if all(known is not None for known in found):
        known = {path for one in found for path in one or ()}
        for path in question.fields:
            if not is_own(path):
                yield from _missing(", ".join(question.topics), path, known)


def _missing(topic: str, path: str, known: Collection[str]) -> Iterator[str]:
    """A sentence that no message of a topic has a field, if it is none of the known ones."""
    plain = path.replace("[]", "")
    if not any(_is_near(plain, name.replace("[]", "")) for name in known):
        near = like(path, known)
        hint = f"; {meant(path, near)}" if near else "."
        yield f"No message of {topic} has a field {path!r}{hint}"


def _is_near(path: str, name: str) -> bool:
    """True if a path is a field, above one, or below one, such as the summary of an array."""
    return path == name or name.startswith(f"{path}.") or path.startswith(f"{name}.")


def _fields_in_tables(session: Session, question: Question, topic: str) -> set[str] | None:
    """Fields of messages of a topic that no definition describes; None if they are not known."""
    summaries = session.summaries_of(replace(question, topics=(topic,)))
    found: set[str] = set()
    for summary in summaries:
        table = session.table(session.entry_of(summary), topic)
        if table is None or summary.status in UNFINISHED or len(summaries) > _MAX_RECORDINGS:
            return None
        found.update(_names_in(table.fields(None), ""))
    return found


def _names_in(kind: Any, above: str) -> Iterator[str]:
    """Paths of the fields of an Arrow type, through lists."""
    from pyarrow import types

    for field in kind:
        inner, path = field.type, f"{above}{field.name}"
        while types.is_list(inner) or types.is_large_list(inner):
            inner = inner.value_type
        if types.is_struct(inner):
            yield from _names_in(inner, f"{path}.")
        else:
            yield path


def _causes(session: Session, question: Question) -> Iterator[str]:
    """Likely causes of an empty answer."""
    if question.during is not None and not len(question.during):
        yield "Nothing matched the condition that gives the times: no time is left to look at."
        return
    if question.bounds is None or not question.is_by_log_time:
        return
    yield from _topics_beside(session, question)
    if others := RangeResolver(session, question).others():
        yield others.strip()


def _topics_beside(session: Session, question: Question) -> Iterator[str]:
    """Topics without a message in the time range, although their recordings have others."""
    spans: dict[str, list[Span]] = defaultdict(list)
    inside: set[str] = set()
    for summary, bounds, _ in islice(RangeResolver(session, question).resolve(), _MAX_RECORDINGS):
        for channel in session.channels_of(session.entry_of(summary), {*question.topics}):
            topic, stats = channel.channel.topic, channel.stats
            if stats.first is None or stats.last is None:
                continue
            spans[topic].append((stats.first, stats.last))
            if bounds is None or (stats.first < bounds[1] and stats.last >= bounds[0]):
                inside.add(topic)
    for topic, found in spans.items():
        if topic not in inside:
            first, last = min(low for low, _ in found), max(high for _, high in found)
            yield (
                f"No message of {topic} is in that time; it has messages from "
                f"{format_time(first)} to {format_time(last)}."
            )
