"""Writes MCAP files with unchanged messages, schemas and channels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import IO, TYPE_CHECKING, Any, cast

from mcap.writer import CompressionType, Writer

from hybridlog.formats.writing import Answer, LogWriter, Sink, Target
from hybridlog_storage.segments.segment_format import OUR_NAMES, Attachment

if TYPE_CHECKING:
    from mcap.records import AttachmentIndex, Statistics

    from hybridlog_storage.messages import Batch, Channel, Schema


def source_metadata(channel: Channel) -> dict[str, str]:
    """A channel's metadata without the keys added by the store."""
    return {key: value for key, value in channel.metadata.items() if not key.startswith(OUR_NAMES)}


class _Writer(Writer):
    """The writer of the mcap package, which otherwise needs an attachment in memory.

    Its private names begin with its own name, and so do those of this class.
    """

    __attachment_indexes: list[AttachmentIndex]
    __statistics: Statistics

    def note_attachment(self, index: AttachmentIndex) -> None:
        """List an attachment whose record was written into the output just now."""
        self.__attachment_indexes.append(index)
        self.__statistics.attachment_count += 1


def write_mcap(answer: Answer, target: Target) -> None:
    """Write one MCAP file."""
    with McapWriter(target, profile=answer.profile) as log:
        log.write_answer(answer)


class McapWriter(LogWriter):
    """Writes one MCAP file with a complete summary."""

    def __init__(self, target: Target, *, profile: str = "") -> None:
        self._sink = Sink(target)
        self._schemas: dict[Schema, int] = {}
        self._ids: dict[tuple[object, ...], int] = {}  # by what is written of a channel
        try:
            self._writer = _Writer(
                cast("IO[Any]", self._sink),
                chunk_size=4 << 20,
                compression=CompressionType.ZSTD,
            )
            self._writer.start(profile=profile, library="hybridlog")
        except BaseException:
            self._sink.abort()
            raise

    def write(self, batch: Batch, channels: Sequence[Channel]) -> None:
        """Append messages in the order of the rows."""
        view = memoryview(batch.buffer)
        add = self._writer.add_message
        ids = {number: self._channel(channels[number]) for number in set(batch.channel.tolist())}
        for channel, start, length, log_time, publish_time, sequence in zip(
            batch.channel.tolist(),
            batch.offset.tolist(),
            batch.length.tolist(),
            batch.log_time.tolist(),
            batch.publish_time.tolist(),
            batch.sequence.tolist(),
            strict=True,
        ):
            # The writer copies the bytes into its chunk at once.
            payload = cast("bytes", view[start : start + length])
            add(ids[channel], log_time, payload, publish_time, sequence)

    def declare(self, channels: Sequence[Channel]) -> None:
        """Add channels, which need have no messages."""
        for channel in channels:
            self._channel(channel)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a metadata record."""
        self._writer.add_metadata(name, dict(values))

    def add_attachment(self, attachment: Attachment) -> None:
        """Add an attachment, piece by piece."""
        offset = self._sink.tell()
        for piece in attachment.record():
            self._sink.write(piece)
        self._writer.note_attachment(attachment.index(offset, self._sink.tell() - offset))

    def _channel(self, channel: Channel) -> int:
        metadata = source_metadata(channel)
        schema = self._schema(channel.schema)
        said = channel.topic, channel.message_encoding, schema, tuple(sorted(metadata.items()))
        if said not in self._ids:
            self._ids[said] = self._writer.register_channel(
                channel.topic, channel.message_encoding, schema, metadata
            )
        return self._ids[said]

    def _schema(self, schema: Schema | None) -> int:
        if schema is None:
            return 0
        if schema not in self._schemas:
            data = schema.data
            number = self._writer.register_schema(schema.name, schema.encoding, data)
            self._schemas[schema] = int(number)
        return self._schemas[schema]

    def commit(self) -> None:
        """Complete the file."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._sink.commit()

    def abort(self) -> None:
        """Remove the file."""
        self._sink.abort()
