"""Attachments and metadata records of recorded logs, read from the segments."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from hybridlog.formats.writing import Sink
from hybridlog.query.planner import bounds_in, resolved
from hybridlog.schema.states import State, state_of
from hybridlog_storage.errors import SegmentError

if TYPE_CHECKING:
    import os

    from mcap.records import AttachmentIndex

    from hybridlog.query.question import Question
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.messages import Channel
    from hybridlog_storage.segments.segment_format import Attachment
    from hybridlog_storage.segments.segment_reader import SegmentSummary
    from hybridlog_storage.segments.walk import Flushed


@dataclass(frozen=True, slots=True)
class StoredAttachment:
    """An attachment of a recording: a file that lay in the log beside its messages.

    Attributes:
        recording: Name of the recording.
        name: Its name in the log; need be no valid file name, and need not be unique.
        media_type: Its media type, such as `text/plain`.
        size: Bytes of its content.
        log_time_ns: Time at which it was recorded, ns; 0 if unknown.
        create_time_ns: Time at which it was created, ns; 0 if unknown.
    """

    recording: str
    name: str
    media_type: str
    size: int
    log_time_ns: int
    create_time_ns: int
    open: Callable[[], Attachment] = field(repr=False, compare=False)
    """Checks its bytes, and gives the record with them."""

    def pieces(self) -> Iterator[bytes]:
        """Its content, checked, in pieces of at most 4 MiB.

        Raises:
            SegmentError: It is damaged; nothing was given then.
        """
        return self.open().pieces()

    def read(self) -> bytes:
        """Its whole content, checked.

        Raises:
            SegmentError: It is damaged.
        """
        return b"".join(self.pieces())

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write its content to a file, which appears when it is complete.

        Raises:
            SegmentError: It is damaged.
            UsageError: The file cannot be written.
            DiskFullError: No space.
        """
        pieces = self.pieces()
        with Sink(path) as sink:
            for piece in pieces:
                sink.write(piece)
        return Path(path)


class StoredMetadata(NamedTuple):
    """A metadata record of a recording.

    Attributes:
        name: Its name; need not be unique.
        values: Its values by key.
    """

    name: str
    values: dict[str, str]


class Extras(NamedTuple):
    """Attachments and metadata records of the recordings of a question.

    Attributes:
        channels: Channels of its topics, also those without messages.
        attachments: Those from before the end of the time range, in the order of the log.
        left_out: Number of attachments from behind the time range.
        problems: Reason for each metadata record that cannot be read.
    """

    channels: list[Channel]
    attachments: list[StoredAttachment]
    metadata: list[StoredMetadata]
    left_out: int
    problems: list[str]


def attachments_of(session: Session, entry: RecordingEntry) -> list[StoredAttachment]:
    """The attachments of a recording, in the order of the log."""
    return [
        StoredAttachment(
            entry.name,
            one.name,
            one.media_type,
            one.data_size,
            one.log_time,
            one.create_time,
            partial(_open, session, entry, number, one),
        )
        for number, summary in (_summaries(session, entry) if entry.attachments else ())
        for one in summary.attachments
    ]


def metadata_of(
    session: Session, entry: RecordingEntry, problems: list[str] | None = None
) -> list[StoredMetadata]:
    """The metadata records of a recording's log, in their order.

    `problems` get the reason for each that cannot be read; without, that is an error.
    """
    found: list[StoredMetadata] = []
    for number, summary in _summaries(session, entry) if entry.metadata_records else ():
        for index in summary.metadata:
            try:
                record = session.segment(entry, number).metadata(index)
            except SegmentError as error:
                if problems is None:
                    raise
                problems.append(str(error))
            else:
                found.append(StoredMetadata(record.name, dict(record.metadata)))
    return found


def extras_of(session: Session, question: Question) -> Extras:
    """Attachments and metadata records that belong to the answer of a question as a slice."""
    found = Extras([], [], [], 0, [])
    left_out = 0
    for summary, *_ in resolved(session, question):
        entry = session.entry_of(summary)
        found.channels.extend(
            channel
            for _, channel in sorted(session.definitions(entry, question.topics).items())
            if state_of(channel.message_encoding) is State.WHOLE
        )
        found.metadata.extend(metadata_of(session, entry, found.problems))
        is_cut = question.bounds is not None and question.clock == "log"
        end = bounds_in(session, question, summary)[1] if is_cut else float("inf")
        for attachment in attachments_of(session, entry):
            if attachment.log_time_ns < end:
                found.attachments.append(attachment)
            else:
                left_out += 1
    return found._replace(left_out=left_out)


def _summaries(
    session: Session, entry: RecordingEntry
) -> Iterator[tuple[int, SegmentSummary | Flushed]]:
    for number in sorted(map(int, entry.digests)):
        yield number, session.segment(entry, number).summary()
    yield from sorted(entry.flushed.items())


def _open(
    session: Session, entry: RecordingEntry, number: int, index: AttachmentIndex
) -> Attachment:
    return session.segment(entry, number).attachment(index)
