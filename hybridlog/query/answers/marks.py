"""Marks in recordings: messages about what happened, at a moment or for a while."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from hybridlog.arrays.message_arrays import plain_type
from hybridlog.message import messages_in
from hybridlog.query.planner import Planner
from hybridlog.query.question import Question
from hybridlog.query.times import decoded_time
from hybridlog.record.marks import MARK
from hybridlog_storage.errors import HybridlogError

if TYPE_CHECKING:
    from hybridlog.message import Message
    from hybridlog.query.question import Counters
    from hybridlog.session import Session

EVENT: Final = "foxglove.Event"
_NAMES: Final = ("text", "name", "title", "event", "type")
"""Keys of the metadata of an event that may say what it is, the best first."""


class Mark(NamedTuple):
    """A mark, or an event of Foxglove.

    Attributes:
        recording: Id of its recording.
        begin: ns since the epoch.
        end: The same; None for a moment.
        text: What happened.
        tags: Further values by name.
    """

    recording: str
    begin: int
    end: int | None
    text: str
    tags: Mapping[str, str]


def mark_topics(session: Session, recordings: Collection[str] | None = None) -> tuple[str, ...]:
    """Full names of the topics with marks in some recordings (ids), or in all."""
    known = session.look(recordings).kinds
    return tuple(sorted({one.topic for one in known if plain_type(one.type) in {MARK, EVENT}}))


def marks(session: Session, question: Question, counters: Counters | None = None) -> Iterator[Mark]:
    """The marks among the messages of a question, in their order.

    Unreadable ones are left out; `counters.unreadable` counts them.
    """
    planner = Planner(session, question, counters)
    for run in planner.runs():
        for message in messages_in(run):
            if plain_type(message.type) not in {MARK, EVENT}:
                continue
            try:
                yield _mark_of(message)
            except HybridlogError:
                planner.counters.unreadable += 1


def marks_in(session: Session, recordings: Collection[str]) -> Iterator[Mark]:
    """All marks of some recordings, in order of log time."""
    topics = mark_topics(session, recordings)
    having = {one.id for one in session.snapshot().having(topics)}
    chosen = tuple(one for one in recordings if one in having)
    if chosen:
        yield from marks(session, Question(topics, chosen))


def _mark_of(message: Message) -> Mark:
    fields: dict[str, Any] = message.fields
    begin: int | None
    if plain_type(message.type) == MARK:
        begin, end = message.log_time_ns, fields.get("end")
        text, tags = fields.get("text"), fields.get("tags")
    else:
        begin, end = (decoded_time(fields.get(f"{edge}_time")) for edge in ("start", "end"))
        found = fields.get("metadata")
        pairs = [one for one in found if isinstance(one, dict)] if isinstance(found, list) else []
        tags = {str(one.get("key")): str(one.get("value")) for one in pairs}
        known = next((tags[name] for name in _NAMES if name in tags), None)
        text = known or ", ".join(f"{key}={value}" for key, value in tags.items())
    begin = message.log_time_ns if begin is None else begin
    lasts = isinstance(end, int) and end > begin
    return Mark(
        message.recording,
        begin,
        end if lasts else None,
        str(text or ""),
        tags if isinstance(tags, dict) else {},
    )
