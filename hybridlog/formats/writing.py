"""Base of all writers: answers in the forms that they take, and atomic output files.

A file appears under its name only when it is complete: it is written beside the target,
synced, and renamed on `commit`. `abort` removes it, and so does an interruption at any
moment: see `unfinished`. Devices, pipes and streams are written directly.
"""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Self, TypeAlias

from msgspec import Struct, field

from hybridlog_storage.disk.files import Unfinished, beside
from hybridlog_storage.errors import (
    NO_SPACE,
    DiskFullError,
    HybridlogError,
    SegmentError,
    UsageError,
)
from hybridlog_storage.settings import NAME as SETTINGS

if TYPE_CHECKING:
    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.message import Message
    from hybridlog_storage.messages import Batch, Buffer, Channel
    from hybridlog_storage.segments.segment_format import Attachment

Line: TypeAlias = "str | Iterator[str]"
"""A line of JSON, or its pieces."""
Target: TypeAlias = "str | os.PathLike[str] | BinaryIO"
"""Target of a writer: a path, or a binary stream, which stays open."""

_WRONG_PLACE = {
    errno.ENOENT,
    errno.ENOTDIR,
    errno.EISDIR,
    errno.EACCES,
    errno.EPERM,
    errno.EROFS,
    errno.ENAMETOOLONG,
    errno.ELOOP,
    errno.EEXIST,
    errno.ENOTEMPTY,
    errno.EINVAL,
}
_BUFFER = 1 << 20


class Answer(Struct, kw_only=True):
    """An answer in the forms that formats take; a format pulls one of them, once.

    Attributes:
        lines: Objects as lines of JSON without their ends, some at a time.
        tables: Rows, at least one table; columns are matched by name.
        is_fixed: The first table has all columns in their types.
        batches: Messages as they came, and the channels that `batch.channel` indexes.
        points: Points, their topic, type and log time (ns), a message at a time.
        messages: Messages that are images.
        extras: What a log has beside its messages: `Extras`, or None.
        profile: MCAP profile of the messages.
        is_live: Rows are written as they come.
        notes: Gets sentences about what is left out: damaged extras, rows without a place.
        unreadable: Gets the error of each message that is left out.
    """

    lines: Iterable[Iterable[Line]] = ()
    tables: Iterable[pa.Table] = ()
    is_fixed: bool = False
    batches: Iterable[tuple[Batch, Sequence[Channel]]] = ()
    points: Iterable[tuple[NDArray[Any], str, str, int]] = ()
    messages: Iterable[Message] = ()
    extras: Any = None
    profile: str = ""
    is_live: bool = False
    notes: list[str] = field(default_factory=list)
    unreadable: list[HybridlogError] = field(default_factory=list)


class Whole:
    """An output that is complete at the end of the block, or absent if the block raises."""

    def __enter__(self) -> Self:
        """Return this output."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Commit, or abort when the block has raised."""
        try:
            if kind is None:
                self.commit()
        finally:
            self.abort()

    def commit(self) -> None:
        """Complete the output; it then stands under its name."""
        raise NotImplementedError

    def abort(self) -> None:
        """Leave nothing behind. Does nothing after `commit`."""
        raise NotImplementedError


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


class Sink(Whole):
    """A binary output that appears on `commit`.

    It has the methods that pyarrow, zipfile and the mcap writer need of a file without seek.
    Others write to its `path`, where it is one.
    """

    def __init__(self, target: Target) -> None:
        self._position = 0
        self._unfinished: Unfinished | None = None
        self._final: Path | None = None
        self._own = True
        self._over = False
        if not isinstance(target, str | os.PathLike):
            self.name = str(getattr(target, "name", "the output"))
            self._file, self._own = target, False
            return
        self.name = os.fspath(target)
        with failures(self.name):
            self._final, atomic = destination(target)
            if atomic:
                self._unfinished = beside(self._final)
            # A path is never opened for reading here, and its links are resolved once.
            self.path = self._unfinished.path if self._unfinished is not None else self._final
            self._file = self.path.open("xb" if atomic else "wb", buffering=_BUFFER)

    @property
    def closed(self) -> bool:
        """True if it is committed or aborted."""
        return self._over

    def write(self, data: Buffer) -> int:
        """Append bytes; returns how many.

        After `abort` they are dropped: libraries write their trailers when they are closed.
        """
        if self._over:
            return memoryview(data).nbytes
        with failures(self.name):
            self._file.write(data)
        size = memoryview(data).nbytes
        self._position += size
        return size

    def tell(self) -> int:
        """Bytes written so far."""
        return self._position

    def flush(self) -> None:
        """Pass buffered bytes to the system."""
        if self._over:
            return
        with failures(self.name):
            self._file.flush()

    def close(self) -> None:
        """Do nothing: libraries close their files, but only the owner may commit."""

    def readable(self) -> bool:
        """False."""
        return False

    def writable(self) -> bool:
        """True."""
        return True

    def seekable(self) -> bool:
        """False."""
        return False

    def commit(self) -> None:
        """Sync, and give the file its name."""
        with failures(self.name):
            self._file.flush()
            if self._unfinished is not None:
                os.fsync(self._file.fileno())
            if self._own:
                self._file.close()
            if self._unfinished is not None and self._final is not None:
                self._unfinished.publish(self._final)
        self._over = True

    def abort(self) -> None:
        """Remove the file; bytes already written to a stream stay."""
        if self._over:
            return
        self._over = True
        if self._own:
            # Closing flushes, which fails again on a full disk.
            with contextlib.suppress(OSError):
                self._file.close()
        if self._unfinished is not None:
            self._unfinished.remove()


def path_of(target: Target, form: str, name: str) -> str | os.PathLike[str]:
    """The path of a format that is no stream."""
    if isinstance(target, str | os.PathLike):
        return target
    raise UsageError(f"{form} is no stream: name {name} with -o.")


def destination(target: str | os.PathLike[str]) -> tuple[Path, bool]:
    """The path to write, with links resolved, and whether a rename can replace it.

    Devices and pipes cannot be replaced.
    """
    if "\0" in os.fspath(target):
        raise UsageError("the output's name has a NUL character")
    path = Path(os.path.realpath(target))
    if path.is_dir():
        raise UsageError(f"{target} is a directory; name a file in it")
    if not path.parent.is_dir():
        raise UsageError(f"cannot write {target}: there is no directory {path.parent}")
    _check_outside(path)
    return path, path.is_file() or not path.exists()


def _check_outside(path: Path) -> None:
    """Raise if a path is within a store, whose files are not to be replaced."""
    for folder in path.parents:
        if (folder / SETTINGS).is_file():
            raise UsageError(f"{path} is within the store {folder}; write it elsewhere")


def new_directory(target: str | os.PathLike[str], content: str) -> tuple[Path, Unfinished]:
    """A missing or empty directory, links resolved, and the unfinished one that will replace it."""
    path = Path(os.path.realpath(target))
    _check_outside(path)
    if path.exists() and not path.is_dir():
        raise UsageError(f"{target} is a file; {content}")
    if path.is_dir() and next(path.iterdir(), None) is not None:
        raise UsageError(f"{target} is not empty; name a directory that does not exist")
    unfinished = beside(path)
    unfinished.path.mkdir()
    return path, unfinished


@contextlib.contextmanager
def failures(name: str) -> Iterator[None]:
    """Map system errors while writing `name` to hybridlog errors, except a broken pipe."""
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        reason = error.strerror or str(error)
        if error.errno in NO_SPACE:
            raise DiskFullError(
                f"no space left for {name}: {reason}; free some, or write to another place with -o"
            ) from error
        if error.errno in _WRONG_PLACE:
            raise UsageError(f"cannot write {name}: {reason}") from error
        raise HybridlogError(f"writing {name} failed: {reason}") from error
