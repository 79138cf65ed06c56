"""Answers in the forms that formats write: lines, tables, batches, points or messages."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

from msgspec import Struct, field

from hybridlog.formats.writing import Whole
from hybridlog_storage.errors import HybridlogError, SegmentError

if TYPE_CHECKING:
    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.attachments import Extras
    from hybridlog.message import Message
    from hybridlog_storage.messages import Batch, Channel
    from hybridlog_storage.segments.segment_format import Attachment

Line: TypeAlias = "str | Iterator[str]"
"""A line of JSON, or its pieces."""


class Answer(Struct, kw_only=True):
    """An answer in the forms that formats take; a format pulls one of them, once.

    Attributes:
        lines: Objects as lines of JSON without their ends, some at a time.
        tables: Rows, at least one table; columns are matched by name.
        schema: Columns of the tables, if they are known before.
        batches: Messages as they came, and the channels that `batch.channel` indexes.
        points: Points, their topic, type and log time (ns), a message at a time.
        messages: Messages that are images.
        extras: What a log has beside its messages.
        profile: MCAP profile of the messages.
        is_live: Rows are written as they come.
        notes: Gets sentences about what is left out: damaged extras, rows without a place.
        unreadable: Gets the error of each message that is left out.
    """

    lines: Iterable[Iterable[Line]] = ()
    tables: Iterable[pa.Table] = ()
    schema: pa.Schema | None = None
    batches: Iterable[tuple[Batch, Sequence[Channel]]] = ()
    points: Iterable[tuple[NDArray[Any], str, str, int]] = ()
    messages: Iterable[Message] = ()
    extras: Extras | None = None
    profile: str = ""
    is_live: bool = False
    notes: list[str] = field(default_factory=list)
    unreadable: list[HybridlogError] = field(default_factory=list)


class LogWriter(Whole):
    """A writer of logs.

    Channels of equal content become one.
    """

    def write(self, batch: Batch, channels: Sequence[Channel]) -> None:
        """Append messages in the order of the rows; `batch.channel` indexes the channels."""
        raise NotImplementedError

    def declare(self, channels: Sequence[Channel]) -> None:
        """Add channels, which need have no messages; those that do not fit are left out."""

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a metadata record, if the format has such."""

    def add_attachment(self, attachment: Attachment) -> None:
        """Add an attachment, piece by piece, if the format has such."""

    def write_answer(self, answer: Answer) -> None:
        """Write an answer; what a log has beside its messages comes first."""
        extras = answer.extras
        if extras is not None:
            self.declare(extras.channels)
            for metadata in extras.metadata:
                self.add_metadata(metadata.name, metadata.values)
            answer.notes += (f"A metadata record is left out: {one}" for one in extras.problems)
            for attachment in extras.attachments:
                try:
                    checked = attachment.open()
                except SegmentError as error:
                    answer.notes.append(f"The attachment {attachment.name!r} is left out: {error}")
                    continue
                self.add_attachment(checked)
        for batch, channels in answer.batches:
            self.write(batch, channels)
