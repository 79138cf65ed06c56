"""The lines of a plot: fields of several topics and recordings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from hybridlog.drawing.series import Series, numbers_of, series
from hybridlog.query.asked import field_types, narrowed, spans_of
from hybridlog.wording import listed
from hybridlog_storage.errors import TopicError, UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.drawing.series import Numbers
    from hybridlog.query.query import Query

MAX_LINES: Final = 50
"""Lines that can be told apart, with good will."""
_GREATEST: Final = 1e300
_MAX_NAMES = 8  # names in a message


@dataclass(frozen=True)
class Line:
    """A field of a topic in a recording.

    Attributes:
        topic: Full name.
        recording: Name.
        start: Beginning of the recording, ns.
        series: The values.
    """

    topic: str
    recording: str
    start: int
    series: Series


def lines(query: Query, fields: Sequence[str], *, pixels: int) -> list[Line]:
    """The fields of a query over time, by topic and recording; the query's counters are set.

    Args:
        query: Each of its topics has a line for each of the fields that it has.
        fields: As for `series`.
        pixels: Width of the picture.

    Raises:
        TopicError: no topic has such a field.
        UsageError: no field, a field that is no number, `reverse`, or more than `MAX_LINES` lines.
        TimeError: the range is outside all recordings.
    """
    if not fields:
        numbers = [name for one in _by_topic(query) for name in numbers_of(one)]
        raise UsageError(f"Name a field, such as {listed(dict.fromkeys(numbers), _MAX_NAMES)}.")
    summaries = {summary.id: summary for summary in query.summaries()}
    with query.counters.timed():
        found: list[Line] = []
        missing: dict[str, TopicError] = {}
        had: set[str] = set()
        for one in _by_topic(query):
            for recording in spans_of(one):
                part = one.in_recording(recording)
                about = summaries[recording]
                for group in _groups(part, fields, missing):
                    try:
                        drawn = series(part, group, pixels=pixels)
                    except TopicError as error:
                        missing.update(dict.fromkeys(group, error))
                        continue
                    query.counters.add(part.counters)
                    had.update(group)
                    found += [Line(one.topics[0], about.name, about.extent[0], x) for x in drawn]
                if len(found) > MAX_LINES:
                    raise UsageError(
                        f"A plot has at most {MAX_LINES} lines: name fewer fields, or choose "
                        "recordings with -r."
                    )
    for field, problem in missing.items():
        if field not in had:
            raise problem
    return found


def _groups(
    query: Query, fields: Sequence[str], missing: dict[str, TopicError]
) -> Iterator[list[str]]:
    """The fields that a topic has, together; one by one where only messages tell.

    Args:
        query: About one topic.
        fields: Paths.
        missing: Gets the fields that it does not have.
    """
    if field_types(query) is None:
        yield from ([field] for field in fields)
        return
    own = []
    for field in fields:
        try:
            query.fields(field.partition("[")[0])
        except TopicError as error:
            missing[field] = error
        else:
            own.append(field)
    if own:
        yield own


def _by_topic(query: Query) -> Iterator[Query]:
    return (narrowed(query, topic) for topic in query.topics)


def drawable(values: Numbers) -> NDArray[np.float64]:
    """Values for an axis: NaN for infinite ones, and none so great that a range overflows."""
    found = np.clip(values.astype(np.float64), -_GREATEST, _GREATEST)
    found[np.isinf(values)] = np.nan
    return found


def printable(text: str) -> str:
    """Text without control characters: names in logs are untrusted."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)
