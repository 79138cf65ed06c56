"""A plain MCAP file: what is written where no index is made."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.backends.database import schema_of
from benchmarks.backends.recording_files import FileBackend, Recorder

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hybridlog_storage.messages import Channel


class McapFile(FileBackend):
    """The `mcap` package's writer with its default settings: chunks of 1 MiB, zstd."""

    name, title = "mcap", "plain MCAP"
    reader = "benchmarks.questions.files:McapReading"
    suffix = ".mcap"

    def _record(self, path: Path) -> Recorder:
        return _McapRecorder(path, self._channels)

    def _count(self, path: Path) -> Mapping[str, int]:
        from mcap.records import Channel, Message
        from mcap.stream_reader import StreamReader

        topics: dict[int, str] = {}
        found: Counter[str] = Counter()
        with path.open("rb") as stream:
            for record in StreamReader(stream, validate_crcs=True).records:
                if isinstance(record, Channel):
                    topics[record.id] = record.topic
                elif isinstance(record, Message):
                    found[topics[record.channel_id]] += 1
        return found


class _McapRecorder:
    def __init__(self, path: Path, channels: Sequence[Channel]) -> None:
        from mcap.writer import Writer

        self._stream = path.open("xb")
        self._writer = Writer(self._stream)
        self._writer.start(profile="ros1", library="")
        self._ids = [self._register(channel) for channel in channels]

    def _register(self, channel: Channel) -> int:
        schema = schema_of(channel)
        number = self._writer.register_schema(schema.name, schema.encoding, schema.data)
        return self._writer.register_channel(
            channel.topic, channel.message_encoding, number, dict(channel.metadata)
        )

    def write(self, channel: int, log_time: int, payload: bytes) -> None:
        self._writer.add_message(self._ids[channel], log_time, payload, log_time)

    def close(self) -> None:
        with self._stream:
            self._writer.finish()  # type: ignore[no-untyped-call]
