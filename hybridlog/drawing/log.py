"""Lines of a text log, around a time."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from hybridlog_storage.errors import HybridlogError, TimeError, UsageError
from hybridlog_storage.lazy import lazy

if TYPE_CHECKING:
    from hybridlog.message import Message
    from hybridlog.query.query import Query

LEVELS: Final = ("debug", "info", "warning", "error", "fatal")
"""From the least to the greatest."""
MAX_TEXT: Final = 4000
"""Most characters of a line."""
_MAX_NAME: Final = 200


@dataclass(frozen=True, slots=True)
class Kind:
    """Fields of a message type that a log line shows.

    Attributes:
        text: Field with the text.
        name: Field with the name of the sender; empty for none.
        levels: Least numbers in the field `level` for each of `LEVELS`; empty for none.
    """

    text: str
    name: str = ""
    levels: tuple[int, ...] = ()


_FOXGLOVE = Kind("message", "name", (1, 2, 3, 4, 5))
KINDS: Final[Mapping[str, Kind]] = {
    "rosgraph_msgs/Log": Kind("msg", "name", (1, 2, 4, 8, 16)),
    "rcl_interfaces/Log": Kind("msg", "name", (10, 20, 30, 40, 50)),
    "foxglove_msgs/Log": _FOXGLOVE,
    "foxglove.Log": _FOXGLOVE,
    "std_msgs/String": Kind("data"),
}
"""Types of messages that are lines of a log, without `msg/`."""


@dataclass(frozen=True, slots=True)
class Line:
    """A line of a log.

    Attributes:
        time: Log time, ns.
        seq: Arrival number in its recording.
        level: One of `LEVELS`; empty if it has none.
        name: Name of the sender.
        text: Its text, or the reason why it cannot be read.
        is_whole: False if the text is cut.
        is_readable: False if the text is that reason.
    """

    time: int
    seq: int
    level: str
    name: str
    text: str
    is_whole: bool = True
    is_readable: bool = True


def kind_of(type_name: str) -> Kind:
    """The fields of a type's messages that a log line shows.

    Raises:
        UsageError: they are no lines of a log.
    """
    kind = KINDS.get(type_name.replace("/msg/", "/"))
    if kind is None:
        raise UsageError(f"{type_name or 'This type'} is no text log; {', '.join(KINDS)} are.")
    return kind


@dataclass(frozen=True)
class Log:
    """The lines of a log that pass some filters.

    Attributes:
        query: About one topic of one recording.
        kind: Its kind of messages.
        level: Least level, one of `LEVELS`; empty for all lines.
        text: Characters that the text or the sender has, in any case; no regular expression.
    """

    query: Query
    kind: Kind
    level: str = ""
    text: str = ""

    @lazy
    def filtered(self) -> Query:
        """The query for these lines."""
        query, kind = self.query, self.kind
        if self.level and kind.levels:
            query = query.where(f"level >= {kind.levels[LEVELS.index(self.level)]}")
        if self.text:
            # Written as numbers, characters mean nothing to the pattern nor to the predicate.
            pattern = "".join(c if c.isalnum() else f"\\x{{{ord(c):x}}}" for c in self.text)
            fields = [field for field in (kind.text, kind.name) if field]
            query = query.where(" or ".join(f'{field} ~ "(?i){pattern}"' for field in fields))
        return query

    def after(self, time: int, seq: int, count: int) -> list[Line]:
        """The next lines, in order.

        Args:
            time: Log time of the line before them, ns.
            seq: Arrival number of that line; -1 for all lines of that time, too.
            count: Most lines.
        """
        beside = self.filtered.between(time, time + 1).where(f"_meta.seq > {seq}")
        return self._read((beside, self.filtered.between(time + 1)), count)

    def before(self, time: int, seq: int, count: int) -> list[Line]:
        """The lines before one, in order; see `after`."""
        beside = self.filtered.between(time, time + 1).where(f"_meta.seq < {seq}").reverse()
        return self._read((beside, self.filtered.between(None, time).reverse()), count)[::-1]

    def count(self) -> int:
        """Number of lines."""
        return self.filtered.count()

    def _read(self, queries: tuple[Query, ...], count: int) -> list[Line]:
        found: list[Line] = []
        for query in queries:
            with suppress(TimeError):  # a range before or behind the recording has no lines
                limited = query.limit(count - len(found))
                found += [_line(message, self.kind) for message in limited]
        return found


def _line(message: Message, kind: Kind) -> Line:
    try:
        fields = message.fields
        if not fields:
            message.content()
    except HybridlogError as error:
        return Line(message.log_time_ns, message.seq, "", "", str(error), is_readable=False)
    text, name = str(fields.get(kind.text, "")), str(fields.get(kind.name, ""))
    return Line(
        message.log_time_ns,
        message.seq,
        _level(fields.get("level"), kind),
        name[:_MAX_NAME],
        text[:MAX_TEXT],
        is_whole=len(text) <= MAX_TEXT,
    )


def _level(value: Any, kind: Kind) -> str:
    if not isinstance(value, int):
        return ""
    reached = [name for name, least in zip(LEVELS, kind.levels, strict=False) if value >= least]
    return reached[-1] if reached else ""
