"""Columns of messages in a file beside the segments, for who asks for the first time.

To look at a document costs MongoDB 0.6 µs, whoever asks; a field of a million messages
that lies in a file of its own is read in a few milliseconds. So while a recording is made,
the fields of its small messages are laid down as columns, too, and the order of all. They
follow from the segments, as the index does: where they are missing or damaged, the index
answers.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from hybridlog.columns.topic import Order, TopicColumns, in_order
from hybridlog.query.column_filter import Single
from hybridlog.schema.column import Scalars, Strings
from hybridlog_storage.column_file import TEXT, ColumnFile, Text, Values
from hybridlog_storage.errors import StoreError

if TYPE_CHECKING:
    from hybridlog_storage.catalog import RecordingEntry

NAME: Final = "fields.columns"
"""Name of the file, in the recording's directory."""
LOG_TIME: Final = ":log_time"
SEQ: Final = ":seq"
"""Columns of a topic besides its fields, of which none has such a name."""
ORDERED: Final = "ordered"
"""Noted of a topic: whether its rows are by log time and arrival."""
RECORDING: Final = "recording"
"""Noted of a topic: the number of its recording."""
_SPECIAL: Final = {"string": TEXT, "time": "<i8", "duration": "<i8"}


class FieldColumns:
    """The columns of one recording, read from their file. Thread safe.

    Args:
        recording: The recording's directory.

    Raises:
        FileNotFoundError: It has none.
        StoreError: They are damaged.
    """

    def __init__(self, recording: Path) -> None:
        self._file = ColumnFile(recording / NAME)

    def has(self, entry: RecordingEntry, topic: str, types: Mapping[str, str]) -> bool:
        """Whether fields of all messages of a topic are there.

        Args:
            entry: The recording.
            topic: Full name.
            types: Of the fields, by path, as the definition says.

        Raises:
            StoreError: What there is of the topic is damaged.
        """
        stored = self._file.types(topic)
        wanted = {LOG_TIME: "int64", SEQ: "int64", **types}
        if not all(_fits(stored.get(name), kind) for name, kind in wanted.items()):
            return False
        notes = self._file.notes(topic)
        if notes.get(RECORDING) != entry.key or self._file.rows(topic) != entry.messages_of(topic):
            return False
        # What is no UTF-8 becomes three bytes; more text than that is not of these messages.
        most = 3 * sum(stats.payload_bytes for stats in entry.stats_of(topic))
        texts = (path for path, kind in types.items() if kind == "string")
        return all(self._file.memory(topic, path) <= most for path in texts)

    def size(self, topic: str, fields: Collection[str], *, ordered: bool) -> int:
        """Bytes to be read for fields of a topic.

        Args:
            topic: Full name; it is there.
            fields: Paths.
            ordered: Whether their order is wanted.
        """
        order = (LOG_TIME, SEQ) if self._needs_order(topic, ordered=ordered) else ()
        return self._file.size(topic, [*order, *fields])

    def read(self, topic: str, types: Mapping[str, str], *, ordered: bool) -> TopicColumns:
        """Fields of all messages of a topic.

        Args:
            topic: Full name.
            types: By path; `has` knows of them.
            ordered: Whether their order is wanted.

        Raises:
            StoreError: They are damaged.
        """
        fields = {path: _column(self._file.read(topic, path), kind) for path, kind in types.items()}
        if not self._needs_order(topic, ordered=ordered):
            return TopicColumns(self._file.rows(topic), None, fields)
        order = self._order(topic)
        return in_order(order.log_time, order.seq, fields)

    def check(self, entry: RecordingEntry) -> None:
        """Read all of them.

        Args:
            entry: The recording.

        Raises:
            StoreError: Something is damaged, or of another recording.
        """
        self._file.check()
        for topic in self._file.tables():
            if not self.has(entry, topic, {}):
                raise StoreError(
                    f"The columns in {self._file.path} have {self._file.rows(topic)} messages "
                    f"of {topic}, the segments {entry.messages_of(topic)}; or they are of another "
                    "recording. Run `hybridlog reindex`."
                )
            self._order(topic)

    def _order(self, topic: str) -> Order:
        times, seqs = self._file.read(topic, LOG_TIME), self._file.read(topic, SEQ)
        assert not isinstance(times, Text)
        assert not isinstance(seqs, Text)
        order = Order(times, seqs)
        if not self._needs_order(topic, ordered=False) and not order.is_kept:
            raise StoreError(
                f"The columns in {self._file.path} are damaged: messages of {topic} are not in "
                "their order. Run `hybridlog reindex`; until then MongoDB answers."
            )
        return order

    def _needs_order(self, topic: str, *, ordered: bool) -> bool:
        """Whether the order has to be read, because it is wanted, or because it is not kept."""
        return ordered or self._file.notes(topic).get(ORDERED) is not True


def _fits(stored: str | None, kind: str) -> bool:
    """Whether columns of a type hold what a definition calls so."""
    if kind in {"byte", "char"}:
        return stored in {"|u1", "|i1"}  # one in ROS 1, the other in ROS 2
    return stored == (_SPECIAL.get(kind) or np.dtype(kind).str)


def values_of(column: Single) -> Values:
    """A column as a file takes it."""
    return Text(column.data, column.offset) if isinstance(column, Strings) else column.values


def _column(values: Values, kind: str) -> Single:
    if isinstance(values, Text):
        return Strings(*values)
    known: tuple[Literal["time", "duration"], ...] = ("time", "duration")
    return Scalars(values, next((name for name in known if name == kind), "number"))
