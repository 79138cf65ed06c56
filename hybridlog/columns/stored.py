"""Columns of small messages in a file beside the segments, for who asks for the first time.

To look at a document costs MongoDB 0.6 µs, whoever asks; a field of a million messages
that lies in a file of its own is read in a few milliseconds. So while a recording is made,
the fields of its small messages are laid down as columns, too. They follow from the
segments, as the index does: where they are missing or damaged, the index answers.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from hybridlog.columns.topic import TopicColumns, in_order
from hybridlog.query.column_filter import Single
from hybridlog.schema.column import Scalars, Strings
from hybridlog_storage.column_file import ColumnFile, Text, Values
from hybridlog_storage.errors import StoreError

if TYPE_CHECKING:
    from hybridlog_storage.catalog import RecordingEntry

NAME: Final = "fields.columns"
"""Name of the file, in the recording's directory."""
LOG_TIME: Final = ":log_time"
SEQ: Final = ":seq"
"""Columns of a topic besides its fields, of which none has such a name."""
ORDERED: Final = "ordered"
"""What is noted of a topic whose rows are by log time and arrival."""


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

    def size(
        self, topic: str, fields: Collection[str], messages: int, *, ordered: bool
    ) -> int | None:
        """Bytes to be read for fields of a topic.

        Args:
            topic: Full name.
            fields: Paths.
            messages: How many the topic has.
            ordered: Whether their order is wanted.

        Returns:
            None when not all of it is there.
        """
        if self._file.rows(topic) != messages or not set(fields) <= self._file.columns(topic):
            return None
        order = (LOG_TIME, SEQ) if self._needs_order(topic, ordered=ordered) else ()
        return self._file.size(topic, [*order, *fields])

    def read(self, topic: str, types: Mapping[str, str], *, ordered: bool) -> TopicColumns:
        """Fields of all messages of a topic.

        Args:
            topic: Full name; `size` knows it.
            types: By path, as the definition says.
            ordered: Whether their order is wanted.

        Raises:
            StoreError: They are damaged.
        """
        fields = {path: _column(self._file.read(topic, path), kind) for path, kind in types.items()}
        if not self._needs_order(topic, ordered=ordered):
            return TopicColumns(self._file.rows(topic), None, fields)
        times, seqs = (self._file.read(topic, name) for name in (LOG_TIME, SEQ))
        if isinstance(times, Text) or isinstance(seqs, Text):
            raise StoreError(f"The columns in {self._file.path} are damaged: times are text.")
        return in_order(times, seqs, fields)

    def _needs_order(self, topic: str, *, ordered: bool) -> bool:
        """Whether the order has to be read, because it is wanted, or because it is not kept."""
        return ordered or self._file.notes(topic).get(ORDERED) is not True

    def check(self, entry: RecordingEntry) -> None:
        """Read all of them.

        Args:
            entry: The recording.

        Raises:
            StoreError: Something is damaged, or of another recording.
        """
        self._file.check()
        for topic in self._file.tables():
            if self._file.rows(topic) != entry.messages_of(topic):
                raise StoreError(
                    f"The columns in {self._file.path} have {self._file.rows(topic)} messages "
                    f"of {topic}, the segments {entry.messages_of(topic)}. Run `hybridlog reindex`."
                )


def values_of(column: Single) -> Values:
    """A column as a file takes it."""
    return Text(column.data, column.offset) if isinstance(column, Strings) else column.values


def _column(values: Values, kind: str) -> Single:
    if isinstance(values, Text):
        return Strings(*values)
    known: tuple[Literal["time", "duration"], ...] = ("time", "duration")
    return Scalars(values, next((name for name in known if name == kind), "number"))
