"""One log: its files, by their content and their names, opened and read as one source."""

from __future__ import annotations

import re
from collections import Counter
from contextlib import nullcontext, suppress
from itertools import chain, pairwise
from pathlib import Path, PureWindowsPath
from stat import S_ISDIR, S_ISREG
from typing import TYPE_CHECKING, Annotated, Final, TypeAlias

import numpy as np
import zstandard
from msgspec import Meta, Struct, ValidationError, convert, field
from msgspec.structs import replace

from hybridlog.formats import LOGS, LogFormat
from hybridlog.formats.reading import (
    BATCH_BYTES,
    ZSTD_MAGIC,
    Damage,
    Source,
    cannot_open,
    peek,
    size_of,
    split,
    spool,
)
from hybridlog.formats.yaml_values import YamlError, parse_yaml
from hybridlog.wording import listed
from hybridlog_storage.errors import SourceError
from hybridlog_storage.messages import MAX_PAYLOAD, Batch
from hybridlog_storage.times import span_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import NDArray


def read_metadata(folder: Path) -> tuple[BagMetadata | None, list[Damage]]:
    """The metadata of the bag in a folder, None without any, and the damage if it is unreadable."""
    path = folder / NAME
    try:
        with path.open("rb") as file:
            return parse_metadata(file.read(MAX_BYTES + 1).decode(errors="replace")), []
    except (FileNotFoundError, NotADirectoryError):
        return None, []
    except OSError as error:
        reason = f"the metadata cannot be read ({error.strerror})"
    except YamlError as error:
        reason = f"the metadata cannot be used ({error}); the files beside it are read without it"
    return None, [Damage(path, 0, None, reason, 0)]


def plain(path: Path) -> str:
    """Name of a file before it was compressed."""
    return path.name.removesuffix(".zstd")


NAME = "metadata.yaml"

MAX_BYTES = 64 << 20
"""Largest metadata; that of 65,535 topics has about 40 MB."""

_Count: TypeAlias = Annotated[int, Meta(ge=0, le=(1 << 63) - 1)]


class _Listed(Struct):
    path: str


class BagMetadata(Struct, frozen=True):
    """The used part of a bag's metadata; the number of messages is None if unknown."""

    listed: list[_Listed] | None = field(default=None, name="files")
    relative_file_paths: list[str] | None = None
    message_count: _Count | None = None

    @property
    def files(self) -> list[str]:
        """Names of its files, in order."""
        paths = self.relative_file_paths or [file.path for file in self.listed or ()]
        # Splits at both kinds of slashes.
        names = dict.fromkeys(PureWindowsPath(path).name for path in paths)
        return [name for name in names if name not in {"", ".."}]


class _Document(Struct):
    bag: BagMetadata = field(name="rosbag2_bagfile_information")


def parse_metadata(text: str) -> BagMetadata:
    """Parse the metadata of a bag."""
    if len(text) > MAX_BYTES:
        raise YamlError(f"it has more than {MAX_BYTES >> 20} MiB")
    try:
        return convert(parse_yaml(text), _Document).bag
    except ValidationError as error:
        raise YamlError(f"it does not describe a bag: {error}") from error


_LONGEST = max(len(start) for log in LOGS for start in log.beginnings)
UNKNOWN: Final = LogFormat("unknown", "", "", (), (), has_end=True)
"""The format of other files."""


class LogFile(Struct, frozen=True):
    """A file of a log.

    Attributes:
        format: Its format, by its first bytes; `UNKNOWN` if it is empty, no log or cannot be read.
        is_packed: Whether it is compressed with zstd.
        problem: Why it cannot be read.
    """

    path: Path
    format: LogFormat = UNKNOWN
    is_packed: bool = False
    problem: SourceError | None = None

    @classmethod
    def at(cls, path: Path) -> LogFile:
        """Look at a file; what is wrong with it is told when it is opened."""
        try:
            with path.open("rb") as file:
                head = file.read(_LONGEST)
            is_packed = head.startswith(ZSTD_MAGIC)
            head = peek(path, _LONGEST) if is_packed else head
        except OSError as error:
            return cls(path, problem=cannot_open(path, error))
        except SourceError as error:
            return cls(path, problem=error)
        found = next((log for log in LOGS if head.startswith(log.beginnings)), UNKNOWN)
        return cls(path, found, is_packed)

    def open(self, unpacked: Path | None = None) -> Source:
        """Open the file, or what it has been unpacked to."""
        if self.problem is not None:
            raise self.problem
        if self.format is not UNKNOWN:
            return self.format.open(unpacked or self.path)
        reason = f"not a log of a known kind; hybridlog reads {kinds()}"
        if self.is_packed:
            reason = "a zstd file that holds no log, or a damaged one; check it with `zstd -t`"
        elif not size_of(self.path):
            reason = "the file is empty; record or copy it again, there is nothing in it"
        raise SourceError(f"{self.path}: {reason}")


def kinds() -> str:
    """The logs that can be read."""
    *others, last = (log.files for log in LOGS)
    return f"{', '.join(others)} and {last}"


# Names of the parts of a split log: `name_3.db3`, `name_2024-05-06-07-08-09_3.bag`, `3.mcap`.
_PART = re.compile(r"(?P<stem>|.*_)(?P<number>[0-9]{1,9})(?P<end>\.[A-Za-z0-9.]*)")
_DATE = re.compile(r"[0-9]{4}(?:[-_][0-9]{2}){5}")


def natural(path: Path) -> list[tuple[int, str]]:
    """A key that sorts names by the numbers in them."""
    return [
        (int(piece), "") if piece.isdecimal() else (-1, piece)
        for piece in re.split(r"([0-9]{1,18})", path.name)
    ]


def part_of(path: Path) -> tuple[tuple[str, str], int]:
    """The log that a file is a part of, and its number in it, by its name; 0 if it has none."""
    found = _PART.fullmatch(plain(path))
    if found is None:
        return (path.name, ""), 0
    return (_DATE.sub("*", found["stem"]), found["end"]), int(found["number"])


def grouped_parts(paths: Iterable[Path]) -> list[list[Path]]:
    """Files of one directory, with the parts of each split log together and in order.

    The names of parts differ in their number, which begins with 0, and perhaps in their date.
    """
    groups: list[list[Path]] = []
    latest: dict[tuple[str, str], tuple[int, list[Path]]] = {}
    for path in sorted(paths, key=natural):
        series, number = part_of(path)
        before, group = latest.get(series, (number, []))
        if number > before:
            group.append(path)
        else:
            groups.append(group := [path])
        if number == 0 or len(group) > 1:
            latest[series] = number, group
    return groups


def is_split(files: Sequence[LogFile]) -> bool:
    """True if files are the parts of one log, by their names and formats."""
    parts = {part_of(file.path) for file in files}
    formats = {file.format for file in files if file.format is not UNKNOWN}
    return len({series for series, _ in parts}) == len(formats) == 1 and len(parts) == len(files)


def missing_parts(files: Sequence[LogFile]) -> list[Damage]:
    """The damage for parts that are missing between others, by their numbers."""
    found = {part_of(file.path)[1]: file.path for file in files}
    return [
        Damage(found[before], None, None, f"no part between it and {found[after].name}", None)
        for before, after in pairwise(sorted(found))
        if after > before + 1
    ]


_CDR = frozenset({"cdr", ""})  # encodings of ROS 2 messages


def open_source(path: Path) -> Source:
    """Open a log: a file, or the directory of a ROS 2 bag or of a split log."""
    return LogSet.at(path).open()


class LogSet(Struct, frozen=True):
    """The files of one log.

    Attributes:
        path: The file, the first of several, or the directory of a ROS 2 bag or a split log.
        parts: The files in reading order.
        damage: Files that are missing, and metadata that cannot be read.
        message_count: Number of all messages by its metadata; None if unknown.
        problem: Why there is no log.
    """

    path: Path
    parts: tuple[LogFile, ...] = ()
    message_count: int | None = None
    damage: tuple[Damage, ...] = ()
    problem: SourceError | None = None

    @classmethod
    def at(cls, path: Path) -> LogSet:
        """The log at a path: a file, or the directory of a ROS 2 bag or of a split log.

        A directory without `metadata.yaml` is a log when it holds exactly one, or the parts of
        one log that was split. What is wrong is told when the log is opened.
        """
        try:
            mode = path.stat().st_mode
            if S_ISDIR(mode) or path.name == NAME:
                return _in_folder(path if S_ISDIR(mode) else path.parent)
            if S_ISREG(mode):
                return cls.of([LogFile.at(path)])
            reason = "neither a file nor a directory; give the path of a log"
            return cls(path, problem=SourceError(f"{path}: {reason}"))
        except OSError as error:
            return cls(path, problem=cannot_open(path, error))
        except SourceError as error:
            return cls(path, problem=error)

    @classmethod
    def of(cls, parts: Sequence[LogFile]) -> LogSet:
        """A file, or the parts of a split log in their order."""
        return cls(parts[0].path, tuple(parts), damage=tuple(missing_parts(parts)))

    @property
    def files(self) -> list[Path]:
        """Paths of its files in reading order."""
        return [part.path for part in self.parts]

    @property
    def size(self) -> int:
        """Bytes of its files that are there."""
        return sum(map(_bytes_at, self.files))

    @property
    def name(self) -> str | None:
        """The name that the parts of a split log share; None for the name of `path`."""
        is_split = len(self.parts) > 1 and self.path == self.parts[0].path
        return self.path.name.rpartition("_")[0] or None if is_split else None

    def open(self) -> Source:
        """Open its files as one source."""
        if self.problem is not None:
            raise self.problem
        if all(part.format is UNKNOWN for part in self.parts):
            self.parts[0].open()
        return _JoinedSource(self)

    def read_time_range(self) -> tuple[int, int] | None:
        """The log time `[start, end)` of its messages, ns; None without messages.

        Files whose own index does not tell it are read.
        """
        times: list[int] = []
        for part in self.parts:
            with suppress(SourceError), LogSet(part.path, (part,)).open() as source:
                if source.time_range is not None:
                    times += source.time_range[0], source.time_range[1] - 1
                    continue
                for batch in source.batches():
                    times += int(batch.log_time.min()), int(batch.log_time.max())
                    times = [min(times), max(times)]
                    source.extras.clear()
        return span_of(min(times), max(times)) if times else None


def _in_folder(folder: Path) -> LogSet:
    """The log in a directory; its metadata need not list all parts, nor right names."""
    bag, damage = read_metadata(folder)
    paths = (path for path in folder.iterdir() if path.name[:1] != "." and path.is_file())
    there = [*map(LogFile.at, sorted(paths, key=natural))]
    logs = [one for one in there if one.format is not UNKNOWN]
    by_name = {plain(one.path): one for one in reversed(there)}
    wanted = {} if bag is None else {folder / name: plain(folder / name) for name in bag.files}
    found = [by_name[name] for name in wanted.values() if name in by_name]
    files = found or logs
    if not found and (not logs or (len(logs) > 1 and not is_split(logs))):
        reason = f"a directory without a log; hybridlog reads {kinds()}"
        if logs:
            names = listed((log.path.name for log in logs), 5)
            reason = f"{len(logs)} logs that are not parts of one ({names})"
        raise SourceError(f"{folder}: {reason}; give the path of a log itself")
    first = next((file for file in files if file.format is not UNKNOWN), None)
    known = {plain(file.path) for file in files}
    for file in (one for one in there if one not in files):
        is_empty = file.format is UNKNOWN and file.problem is None and not size_of(file.path)
        is_log = file.format is not UNKNOWN or is_empty
        is_part = first is not None and is_log and is_split([first, file])
        if is_part and plain(file.path) not in known:
            files = sorted([*files, file], key=lambda one: natural(one.path))
        elif file.format is not UNKNOWN:  # the log lacks nothing by that
            reason = "the file is not read: it is no part of this log; record it by its own path"
            damage.append(Damage(file.path, None, None, reason, 0))
    if bag is None:
        damage += missing_parts(files)
    for path in (path for path, name in wanted.items() if found and name not in by_name):
        damage.append(Damage(path, None, None, f"the file is missing; {NAME} lists it", None))
    count = None if bag is None else bag.message_count
    return LogSet(folder, tuple(files), count, tuple(damage))


def _bytes_at(path: Path) -> int:
    """Bytes of a file, 0 where there is none."""
    return path.stat().st_size if path.exists() else 0


# Reading.


class _JoinedSource(Source):
    """Files of one log, read one after the other; only one is open at a time.

    Equal channels of all files become one channel. An unreadable file counts as damage,
    unless all are unreadable.
    """

    def __init__(self, log: LogSet) -> None:
        form = next(part.format for part in log.parts if part.format is not UNKNOWN)
        super().__init__(log.path, kind="", profile=form.profile, files=log.files)
        self._log = log
        self._got = 0
        for damage in log.damage:
            self.note(damage)
        self._numbers: dict[tuple[object, ...], int] = {}
        self._alike: Counter[tuple[object, ...]] = Counter()  # channels of a file
        self._inner: Source | None = None
        with suppress(SourceError) if len(log.parts) > 1 else nullcontext():
            self._inner = self._open(log.parts[0])
            if len(log.parts) == 1:
                self.message_count = self._inner.message_count
                self.time_range = self._inner.time_range
        self.kind = self.kind or form.name

    def close(self) -> None:
        """Close the open file."""
        if self._inner is not None:
            self._inner.close()
        self._inner = None

    def batches(self) -> Iterator[Batch]:
        """Yield the messages of each file in turn."""
        done, failed = 0, list[SourceError]()
        for part in self._log.parts:
            size = _bytes_at(part.path)
            try:
                inner = self._inner = self._inner or self._open(part)
            except SourceError as error:
                failed.append(error)
                reason = _without_path(error, part.path)
                self.damage.append(Damage(part.path, 0, size, reason, None))
            else:
                with inner:
                    yield from self._read(part, inner, done, size)
                self._inner = None
            done += size
            self.bytes_read = done
        if len(failed) == len(self._log.parts):
            raise failed[0]
        if self._log.message_count is not None:
            self.settle(self._log.message_count, self._got, self.path / NAME)

    def _open(self, part: LogFile) -> Source:
        inner = self._unspooled(part) if part.is_packed else part.open()
        self.profile = self.profile or inner.profile
        self.kind = self.kind or inner.kind
        self.extras += inner.extras
        inner.extras = self.extras
        return inner

    def _unspooled(self, part: LogFile) -> Source:
        """Open a compressed file, by way of a temporary one."""
        path, problem = spool(part.path)
        try:
            inner = part.open(path)
        except SourceError as error:
            reason = problem or _without_path(error, path)
            raise SourceError(
                f"{part.path}: {reason}; try to unpack it with `zstd -d` and use what comes out"
            ) from error
        finally:
            path.unlink(missing_ok=True)
        if problem is not None:
            self.damage.append(Damage(part.path, None, None, problem, None))
        return inner

    def _read(self, part: LogFile, inner: Source, done: int, size: int) -> Iterator[Batch]:
        """Yield the messages of one open file, over the channels of this source."""
        numbers = np.empty(0, np.int32)
        self._alike.clear()
        for batch in self._unpacked(inner):
            self._got += len(batch)
            numbers = self._numbered(inner, numbers)
            share = inner.bytes_read / inner.size_bytes if inner.size_bytes else 1.0
            self.bytes_read = done + int(size * min(share, 1.0))
            yield replace(batch, channel=numbers[batch.channel])
        self._numbered(inner, numbers)
        self.damage.extend(replace(damage, file=part.path) for damage in inner.damage)
        self.remarks += inner.remarks

    def _numbered(self, inner: Source, numbers: NDArray[np.int32]) -> NDArray[np.int32]:
        """Numbers of the channels of a file in this source.

        Equal channels of one file are publishers of their own, of two files the same ones.
        """
        more = []
        for channel in inner.channels[len(numbers) :]:
            metadata = tuple(sorted(channel.metadata.items()))
            about = channel.topic, channel.message_encoding, channel.schema
            said = *about, metadata, channel.has_publish_time
            self._alike[said] += 1
            key = self._alike[said], *said
            if key not in self._numbers:
                self._numbers[key] = self.add_channel(channel)
            more.append(self._numbers[key])
        return np.append(numbers, np.array(more, np.int32)) if more else numbers

    def _unpacked(self, inner: Source) -> Iterator[Batch]:
        """Unpack messages of CDR that are zstd frames, whatever the log says of them.

        CDR never begins like a frame. Frames that do not unpack stay as they are.
        """
        may_be = np.empty(0, np.bool_)
        for batch in chain.from_iterable(map(split, inner.batches())):
            if len(may_be) < len(inner.channels):
                may_be = np.array([c.message_encoding in _CDR for c in inner.channels], np.bool_)
            packed = may_be[batch.channel] & _is_frame(batch)
            yield from _unpacked_rows(batch, packed) if packed.any() else (batch,)


def _unpacked_rows(batch: Batch, packed: NDArray[np.bool_]) -> Iterator[Batch]:
    """A batch with its frames unpacked, in parts."""
    unpacker, row = zstandard.ZstdDecompressor(), 0
    while row < len(batch):
        start, size = row, 0
        payloads: list[bytes] = []
        while row < len(batch) and size < BATCH_BYTES:
            payload = bytes(batch.payload(row))
            payloads.append(_unpack_payload(unpacker, payload) if packed[row] else payload)
            size += len(payloads[-1])
            row += 1
        length = np.fromiter(map(len, payloads), np.int64, len(payloads))
        rows, offset = batch.take(slice(start, row)), length.cumsum() - length
        yield replace(rows, buffer=b"".join(payloads), length=length, offset=offset)


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


def _unpack_payload(unpacker: zstandard.ZstdDecompressor, payload: bytes) -> bytes:
    """The content of a zstd frame; the payload itself where that is damaged or too large."""
    try:
        is_large = zstandard.frame_content_size(payload) > MAX_PAYLOAD
        return payload if is_large else unpacker.decompress(payload, MAX_PAYLOAD)
    except zstandard.ZstdError:
        return payload


def _without_path(error: SourceError, path: Path) -> str:
    return str(error).removeprefix(f"{path}: ")
