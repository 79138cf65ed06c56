"""Reads several files of one log as one source, and whole-file compression."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import zstandard

from hybridlog.formats.reading import BATCH_BYTES, Damage, Source, regroup
from hybridlog.formats.spool import ZSTD_MAGIC, spool
from hybridlog_storage.errors import SourceError
from hybridlog_storage.messages import MAX_PAYLOAD, Batch, Channel

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

_CDR = frozenset({"cdr", ""})  # encodings of ROS 2 messages


@dataclass(frozen=True, slots=True)
class Part:
    """One file of a log.

    Attributes:
        path: The file.
        message_count: Number of messages by the log's metadata, None if unknown.
        packed: Whether the file is compressed with zstd.
        packed_messages: Whether each payload is a zstd frame.
    """

    path: Path
    message_count: int | None = None
    packed: bool = False
    packed_messages: bool = False


class Total(NamedTuple):
    """The number of messages in all files, by the log's metadata.

    Attributes:
        path: File of the metadata.
        messages: Number of messages.
    """

    path: Path
    messages: int


class JoinedSource(Source):
    """Files of one log, read one after the other; only one is open at a time.

    Equal channels of all files become one channel. An unreadable file counts as damage,
    unless all are unreadable.

    Args:
        path: The opened path.
        kind: See `Source`; empty to take it from the files.
        profile: See `Source`; empty to take it from the files.
        parts: The files in order, at least one.
        opener: Opens one uncompressed file by its content.
        damage: Damage known beforehand (missing files).
        gaps: Files that seem to be missing; damage unless all messages of `total` are there.
        unread: Files that are left out.
        total: Number of messages in all files by the log's metadata.
    """

    def __init__(
        self,
        path: Path,
        *,
        kind: str,
        profile: str,
        parts: Sequence[Part],
        opener: Callable[[Path], Source],
        damage: Sequence[Damage] = (),
        gaps: Sequence[Damage] = (),
        unread: Sequence[Damage] = (),
        total: Total | None = None,
    ) -> None:
        super().__init__(path, kind=kind, profile=profile, files=[part.path for part in parts])
        self._parts = list(parts)
        self._opener = opener
        self._gaps = list(gaps)
        self._unread = list(unread)
        self._total = total
        self._got = 0
        self.damage.extend(damage)
        self._numbers: dict[tuple[object, ...], int] = {}
        self._inner: Source | None = None
        self._open_part: Source | None = None
        if len(self._parts) == 1:
            # With one file, its error is raised at once.
            self._open_part = self._open(self._parts[0])
            self.profile = self._open_part.profile or profile
            self.kind = kind or self._open_part.kind
            self.message_count = self._open_part.message_count
            self.time_range = self._open_part.time_range

    def look(self) -> None:
        """Add up the statements of each uncompressed file about itself."""
        if self._open_part is not None or any(part.packed for part in self._parts):
            return
        counts: list[int | None] = []
        ranges: list[tuple[int, int]] = []
        for part in self._parts:
            try:
                with self._opener(part.path) as inner:
                    self.profile = self.profile or inner.profile
                    self.kind = self.kind or inner.kind
                    counts.append(inner.message_count)
                    if inner.time_range is not None:
                        ranges.append(inner.time_range)
                    elif inner.message_count != 0:
                        return
            except SourceError:
                return
        known = [count for count in counts if count is not None]
        if len(known) == len(counts):
            self.message_count = sum(known)
        if ranges:
            self.time_range = (min(low for low, _ in ranges), max(high for _, high in ranges))

    def close(self) -> None:
        """Close the open file."""
        for source in (self._inner, self._open_part):
            if source is not None:
                source.close()
        self._inner = self._open_part = None

    def batches(self) -> Iterator[Batch]:
        """Yield the messages of each file in turn."""
        done = failed = 0
        first: SourceError | None = None
        for part, size in zip(self._parts, self._sizes(), strict=True):
            try:
                inner = self._inner = self._open_part or self._open(part)
            except SourceError as error:
                failed += 1
                first = first or error
                reason = _without_path(error, part.path)
                self.damage.append(Damage(part.path, 0, size, reason, part.message_count))
            else:
                self.profile = self.profile or inner.profile
                with inner:
                    self._open_part = None
                    yield from self._read(part, inner, done, size)
                self._inner = None
            done += size
            self.bytes_read = done
        if first is not None and failed == len(self._parts):
            raise first
        self._check_total()
        self.damage.extend(self._unread)

    def _sizes(self) -> list[int]:
        sizes = []
        for part in self._parts:
            try:
                sizes.append(part.path.stat().st_size)
            except OSError:
                sizes.append(0)
        return sizes

    def _open(self, part: Part) -> Source:
        if not part.packed:
            return self._opener(part.path)
        spooled = spool(part.path)
        try:
            inner = self._opener(spooled.path)
        except SourceError as error:
            reason = spooled.problem or _without_path(error, spooled.path)
            raise SourceError(
                f"{part.path}: {reason}; try to unpack it with `zstd -d` and use what comes out"
            ) from error
        finally:
            spooled.remove()
        if spooled.problem is not None:
            self.damage.append(Damage(part.path, None, None, spooled.problem, None))
        return inner

    def _read(self, part: Part, inner: Source, done: int, size: int) -> Iterator[Batch]:
        """Yield the messages of one open file, over the channels of this source."""
        numbers = np.empty(0, np.int32)
        alike: Counter[tuple[object, ...]] = Counter()
        got = 0
        found_before = len(self.damage)
        batches = self._unpacked(part, inner, inner.batches())
        if part.packed_messages or inner.packed_messages:
            batches = regroup(batches)
        for batch in batches:
            got += len(batch)
            if len(numbers) < len(inner.channels):
                more = [self._number(each, alike) for each in inner.channels[len(numbers) :]]
                numbers = np.append(numbers, np.array(more, np.int32))
            share = inner.bytes_read / inner.size_bytes if inner.size_bytes else 1.0
            self.bytes_read = done + int(size * min(share, 1.0))
            self._take_extras(inner)
            yield Batch(
                batch.buffer,
                batch.offset,
                batch.length,
                numbers[batch.channel],
                batch.log_time,
                batch.publish_time,
                batch.sequence,
            )
        self._take_extras(inner)
        for channel in inner.channels[len(numbers) :]:
            self._number(channel, alike)
        self.damage.extend(replace(damage, file=part.path) for damage in inner.damage)
        self.remarks.extend(f"{part.path}: {remark}" for remark in inner.remarks)
        self._got += got
        if part.message_count is not None:
            self._check_count(Total(part.path, part.message_count), got, found_before)

    def _check_total(self) -> None:
        """Compare with the number of all messages in the metadata."""
        lost = sum(damage.messages_lost or 0 for damage in self.damage)
        if self._total is None or self._got + lost < self._total.messages:
            self.damage.extend(self._gaps)
        if self._total is not None:
            self._check_count(self._total, self._got, 0)

    def _check_count(self, total: Total, got: int, found_before: int) -> None:
        """Compare with a number of messages in the metadata."""
        found = self.damage[found_before:]
        if got >= total.messages:
            return
        missing = total.messages - got - sum(damage.messages_lost or 0 for damage in found)
        unknown = [row for row, damage in enumerate(found) if damage.messages_lost is None]
        if len(unknown) == 1:
            row = found_before + unknown[0]
            self.damage[row] = replace(self.damage[row], messages_lost=max(0, missing))
        elif not unknown and missing > 0:
            reason = f"the log's metadata lists {total.messages} messages, {got} are there"
            self.damage.append(Damage(total.path, None, None, reason, missing))

    def _take_extras(self, inner: Source) -> None:
        self.extras.extend(inner.extras)
        inner.extras.clear()

    def _number(self, channel: Channel, alike: Counter[tuple[object, ...]]) -> int:
        """Index of a channel in this source.

        Equal channels of one file are publishers of their own, of two files the same ones.

        Args:
            channel: The channel.
            alike: Numbers of the channels of its file so far, by what they have in common.
        """
        schema = channel.schema
        key = (
            channel.topic,
            channel.message_encoding,
            None if schema is None else (schema.name, schema.encoding, schema.data),
            tuple(sorted(channel.metadata.items())),
            channel.has_publish_time,
        )
        alike[key] += 1
        nth = (alike[key], *key)
        number = self._numbers.get(nth)
        if number is None:
            number = self._numbers[nth] = len(self.channels)
            self.channels.append(channel)
        return number

    def _unpacked(self, part: Part, inner: Source, batches: Iterator[Batch]) -> Iterator[Batch]:
        """Unpack payloads that are zstd frames; the others stay as they are.

        In a log that does not say so only CDR is unpacked, which never begins like a frame.
        """
        is_stated = part.packed_messages or inner.packed_messages
        may_be = np.empty(0, np.bool_)
        unpacker = zstandard.ZstdDecompressor()
        broken = plain = 0
        for batch in batches:
            if len(may_be) < len(inner.channels):
                may_be = np.array(
                    [is_stated or c.message_encoding in _CDR for c in inner.channels], np.bool_
                )
            packed = may_be[batch.channel] & _is_frame(batch)
            plain += len(batch) - int(packed.sum())
            if not packed.any():
                yield batch
                continue
            start = 0
            while start < len(batch):
                payloads: list[bytes] = []
                size = 0
                row = start
                while row < len(batch) and size < BATCH_BYTES:
                    payload = bytes(batch.payload(row))
                    data = _unpack_payload(unpacker, payload) if packed[row] else payload
                    broken += data is None
                    payloads.append(payload if data is None else data)
                    size += len(payloads[-1])
                    row += 1
                rows = batch.take(np.arange(start, row, dtype=np.intp))
                rows.buffer = b"".join(payloads)
                rows.length = np.fromiter(map(len, payloads), np.int64, len(payloads))
                rows.offset = np.cumsum(rows.length) - rows.length
                yield rows
                start = row
        if not is_stated:
            return
        for count, problem in ((broken, "do not unpack"), (plain, "are not compressed")):
            if count:
                reason = (
                    f"{count} payloads {problem}, although the bag says they are compressed; they "
                    "are taken as they are"
                )
                self.damage.append(Damage(part.path, None, None, reason, 0))


def _is_frame(batch: Batch) -> NDArray[np.bool_]:
    """Test which payloads begin like a zstd frame; return bool[n]."""
    found = batch.length >= len(ZSTD_MAGIC)
    if found.any():
        size = len(batch.buffer) - len(ZSTD_MAGIC) + 1
        # A view of four bytes at every byte of the buffer; only the needed ones are read.
        starts = np.ndarray((size,), "<u4", batch.buffer, strides=(1,))
        magic = int.from_bytes(ZSTD_MAGIC, "little")
        found[found] = starts[batch.offset[found]] == magic
    return found


def _unpack_payload(unpacker: zstandard.ZstdDecompressor, payload: bytes) -> bytes | None:
    """The content of a zstd frame, None if it is damaged or too large."""
    try:
        size = zstandard.frame_content_size(payload)
        if size > MAX_PAYLOAD:
            return None
        if size >= 0:
            return unpacker.decompress(payload)
        with unpacker.stream_reader(payload) as reader:
            data = reader.read(MAX_PAYLOAD + 1)
    except zstandard.ZstdError:
        return None
    return data if len(data) <= MAX_PAYLOAD else None


def _without_path(error: SourceError, path: Path) -> str:
    return str(error).removeprefix(f"{path}: ")
