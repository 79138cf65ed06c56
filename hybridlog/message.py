"""A message of an answer; its content is decoded on access."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NoReturn, TypeAlias, cast

import numpy as np

from hybridlog.query.times import format_time
from hybridlog.schema.column import Records
from hybridlog.schema.states import State
from hybridlog_storage.errors import HybridlogError, PayloadError

if TYPE_CHECKING:
    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.query.chunk_scan import MessageRun
    from hybridlog.schema.codec import Decoded


PictureOf: TypeAlias = "Callable[[Message], NDArray[Any]]"
"""Decodes a frame of video."""


class Message:
    """One message of an answer. Its payload is decoded on access.

    Attributes:
        topic: Its topic.
        type: Its type, as the source spells it.
        log_time_ns: Time at which the recorder received it, nanoseconds since the epoch.
        publish_time_ns: Time at which it was sent, by the sender's clock; None if unknown.
        sequence: The sender's sequence number, 0 if unknown.
        seq: Arrival number in its recording.
        recording: Id of its recording.
        state: `whole`; or `reduced`, `expired` or `not_copied`, if its payload was dropped under
            pressure, deleted to make room, or not copied yet.
    """

    __slots__ = (
        "_channel",
        "_of",
        "_picture_of",
        "_row",
        "_view",
        "log_time_ns",
        "publish_time_ns",
        "recording",
        "seq",
        "sequence",
        "state",
        "topic",
        "type",
    )

    def __init__(
        self, of: Messages, row: int, numbers: Sequence[int], picture_of: PictureOf | None
    ) -> None:
        index, log_time, publish_time, sequence, seq, start, size = numbers
        self._of, self._row, self._picture_of = of, row, picture_of
        self._channel = of.channels[index]
        self._view = of.view[start : start + size]
        described = self._channel.channel
        self.topic = described.topic
        self.type = described.schema.name if described.schema is not None else ""
        self.log_time_ns = log_time
        self.publish_time_ns = publish_time if described.has_publish_time else None
        self.sequence = sequence
        self.seq = seq
        self.recording = self._channel.recording.id
        self.state = self._channel.state

    def __repr__(self) -> str:
        return f"<Message {self.topic} {format_time(self.log_time_ns)} {len(self._view)} B>"

    def _repr_html_(self) -> str:
        """The message in a notebook: its first fields."""
        from hybridlog.drawing.notebook import message_html

        try:
            fields = self.fields
        except HybridlogError as error:
            fields = {"problem": str(error)}
        return message_html(f"{self.topic} {self.type} {format_time(self.log_time_ns)}", fields)

    @property
    def raw(self) -> bytes:
        """The serialized message, byte for byte as received.

        Raises:
            PayloadError: the payload was dropped under pressure, or deleted to make room.
        """
        return bytes(self.payload)

    @property
    def payload(self) -> memoryview:
        """The serialized message without a copy."""
        if self.is_reduced:
            self.decode()
        return self._view

    @property
    def is_reduced(self) -> bool:
        """True if the payload is gone, and only `fields` are available; `state` says why."""
        return self.state is not State.WHOLE

    @property
    def fields(self) -> dict[str, object]:
        """Its fields as in the index: long arrays are summaries."""
        return self._of.fields(self._row)

    @property
    def header_stamp_ns(self) -> int | None:
        """The header stamp, nanoseconds; None without a header, or if it is zero: not set."""
        header = self.fields.get("header")
        stamp = header.get("stamp") if isinstance(header, dict) else None
        return stamp if isinstance(stamp, int) and stamp else None

    def decode(self) -> Any:
        """The whole message as an object with the fields as attributes.

        Raises:
            PayloadError: the payload does not fit its definition.
            DefinitionError: no usable definition exists.
        """
        if self.is_reduced:
            self._of.refuse(self._row)
        return self._channel.codec.decode(self._view)

    def content(self) -> pa.StructScalar | Mapping[str, Any]:
        """Its fields with exact values, arrays whole and without a copy where possible.

        A dictionary if messages of its encoding can lack fields. Of a message whose payload was
        dropped, what `fields` holds.

        Raises:
            PayloadError: the payload does not fit its definition.
            DefinitionError: no usable definition exists.
        """
        decoded = self._of.decoded(self._row)
        records = decoded.records
        values: Any = decoded.arrow() if isinstance(records, Records) else records.plain()
        return cast("pa.StructScalar | Mapping[str, Any]", values[0])

    def to_numpy(self) -> NDArray[Any]:
        """An image, scan or point cloud as an array; a frame of video as its picture.

        Raises:
            PayloadError: another type, or sizes that do not fit the data. Of a frame: one that
                it refers to is missing.
            MissingDependencyError: Pillow or PyAV is required and not installed.
        """
        from hybridlog.arrays import is_video_type
        from hybridlog.arrays.message_arrays import to_numpy

        if self._picture_of is not None and is_video_type(self.type):
            return self._picture_of(self)
        return to_numpy(self.type, self.decode())


class Messages:
    """The messages of a run; their index documents are created together on first access."""

    def __init__(self, run: MessageRun) -> None:
        self.channels = run.channels
        self.view = memoryview(run.batch.buffer)
        self._batch = run.batch
        self._bodies: dict[int, bytes] = {}

    def fields(self, row: int) -> dict[str, object]:
        """The fields of one message, as in its index document."""
        from hybridlog.schema.codecs import bodies_of, document_of

        if row not in self._bodies:
            index = int(self._batch.channel[row])
            rows = np.flatnonzero(self._batch.channel == index)
            for group in bodies_of(self.channels[index].codec, self._batch.take(rows)):
                for own, body in zip(rows[group.rows].tolist(), group.body, strict=True):
                    self._bodies[own] = body.tobytes()
        return document_of(self._bodies[row])

    def decoded(self, row: int) -> Decoded:
        """The columns of one message."""
        codec = self.channels[int(self._batch.channel[row])].codec
        decoded = codec.columns_of(self._batch.take(slice(row, row + 1)))
        if decoded.unreadable:
            raise PayloadError(f"the payload cannot be read: {decoded.unreadable[0].reason}")
        return decoded

    def refuse(self, row: int) -> NoReturn:
        """Refuse a payload that is gone."""
        from hybridlog.columns.rows import digest_in, with_rows
        from hybridlog.schema.codecs import missing_payload

        left = with_rows(self._batch.take(slice(row, row + 1))).left
        assert left is not None
        state = self.channels[int(self._batch.channel[row])].state
        size, digest = digest_in(left, 0)
        raise missing_payload(state, f" ({size} bytes, SHA-256 {digest.hex()})")


def messages_in(run: MessageRun, picture_of: PictureOf | None = None) -> Iterator[Message]:
    """The messages of a run, in its order; with pictures of frames of video if asked for."""
    of, batch = Messages(run), run.batch
    # Columns are converted to lists at once: access to single numbers of arrays is slow.
    columns = (
        batch.channel,
        batch.log_time,
        batch.publish_time,
        batch.sequence,
        run.seq,
        batch.offset,
        batch.length,
    )
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return (Message(of, row, numbers, picture_of) for row, numbers in enumerate(rows))
