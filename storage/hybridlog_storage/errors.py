"""All errors that hybridlog raises on purpose, in one tree.

Classes are grouped by what a caller can do about them. Each group has an exit code of the
command line. A message names the cause, the place, and the cure. Errors of libraries
(pymongo, sqlite3, mcap, zstandard, pyarrow, rosbags) are mapped to one of these where
they are caught.
"""

from __future__ import annotations

import errno
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, ClassVar, Final

if TYPE_CHECKING:
    from pathlib import Path

NO_SPACE: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""System errors that mean a full disk."""
NO_HANDLES: Final = frozenset({errno.EMFILE, errno.ENFILE})
"""System errors that mean too few file handles."""
_ADDRESS: Final = re.compile(r"\b(s3|gs|az):/(?!/)")


def exhausted(number: int | None, doing: str) -> ResourceError | None:
    """The error for a system error that means too few handles or too little memory."""
    if number in NO_HANDLES:
        return ResourceError(
            f"Out of file handles while {doing}: raise the limit with `ulimit -n 8192`, or close "
            "some stores and files."
        )
    if number == errno.ENOMEM:
        return ResourceError(f"Out of memory while {doing}: end other programs, or add memory.")
    return None


def unreadable(error: OSError, path: Path, subject: str = "") -> HybridlogError:
    """The error for a file or folder that cannot be read: a shortage, or a `StoreError`.

    The message calls it `subject`, or by its path.
    """
    problem = f"{subject or path} cannot be read: {error.strerror}."
    return exhausted(error.errno, f"reading {path}") or StoreError(problem)


class HybridlogError(Exception):
    """Root of the tree."""

    exit_code: ClassVar[int] = 1

    def __str__(self) -> str:
        """The message; what was a path in a bucket is an address again."""
        return _ADDRESS.sub(r"\1://", super().__str__())

    def _render_traceback_(self) -> list[str]:
        """The error in a notebook, which asks for this: without the way to it."""
        return [f"{type(self).__name__}: {self}"]


class UsageError(HybridlogError):
    """An invalid question: a time, a predicate, an option."""

    exit_code = 2


class TimeError(UsageError):
    """An invalid time or time range."""


class WhereError(UsageError):
    """A predicate that cannot be parsed or is not allowed."""


class TopicError(UsageError):
    """An unknown topic, recording or field, or an ambiguous name."""


class TransformError(UsageError):
    """No transform between two frames at a time."""


class SourceError(HybridlogError):
    """An input file of which nothing can be read: missing, unreadable, empty, of the wrong kind."""

    exit_code = 3


class SourceDamagedError(HybridlogError):
    """A damaged input file; the readable part is stored."""

    exit_code = 4


class StoreError(HybridlogError):
    """An unusable store: missing, read-only, of a newer format, damaged."""

    exit_code = 5


class HeldError(StoreError):
    """Another process holds a recording's lock."""


class SegmentError(StoreError):
    """A segment of the store that cannot be read."""


class ChangedError(StoreError):
    """Files of a recording were replaced while a question was about them. Ask again."""


class BucketError(HybridlogError):
    """A bucket that does not answer, refuses access, or ignores conditions of writers."""

    exit_code = 5


class ObjectChangedError(BucketError):
    """An object is not the version any more that was read. Ask again."""


class ManifestError(StoreError):
    """A manifest that is damaged. `verify --repair` makes it again."""


class ExistsError(StoreError):
    """A recording that is in the store already, or an object of this name in a bucket."""


class RecordingGoneError(StoreError):
    """A recording that is not in the store, or no longer."""


class DatabaseError(HybridlogError):
    """MongoDB does not answer, refuses, or has ended."""

    exit_code = 6


class WithoutMongoError(DatabaseError):
    """The store is used without MongoDB, as was asked for."""


class ConnectionLostError(DatabaseError):
    """The connection to MongoDB has ended, or there is none. A new one may work."""


class ResourceError(HybridlogError):
    """Too few file handles, too little memory, or no space on a disk."""

    exit_code = 7


class DiskFullError(ResourceError):
    """No space left on the store's disk."""


class AlreadyRecordedError(HybridlogError):
    """The content of the file is in the store already."""

    exit_code = 8


class MissingDependencyError(HybridlogError):
    """An optional package is missing; the message says how to install it."""

    exit_code = 9


@contextmanager
def extra(name: str, what: str) -> Iterator[None]:
    """Say which extra is to be installed where a package cannot be imported."""
    try:
        yield
    except ImportError as error:
        raise MissingDependencyError(f"{what}: pip install 'hybridlog[{name}]'") from error


class DefinitionError(HybridlogError):
    """A message definition that is missing, malformed or hostile.

    Messages of that type are still stored and fetched byte for byte. Only their fields
    are not indexed.
    """

    exit_code = 10


class IncompleteError(HybridlogError):
    """Messages of the asked range are lost, and the answer had to be complete."""

    exit_code = 11


class PayloadError(HybridlogError):
    """A payload that does not fit its definition."""

    exit_code = 10
