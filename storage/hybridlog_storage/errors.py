"""Every error that hybridlog raises on purpose, in one tree.

Classes are grouped by what a caller can do about them, and each group has an exit
code of its own, which the command line uses. A message names the thing that is
wrong, the place, and what to do next. Errors of drivers (pymongo, sqlite3, mcap,
zstandard, pyarrow, rosbags) are mapped to one of these where they are caught.
"""

from __future__ import annotations

import errno
from typing import ClassVar, Final

NO_SPACE: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""Numbers of system errors that mean that nothing more can be written."""


class HybridlogError(Exception):
    """Root of the tree."""

    exit_code: ClassVar[int] = 1


class UsageError(HybridlogError):
    """The question is wrong: a time, a predicate, an option. Ask it differently."""

    exit_code = 2


class TimeError(UsageError):
    """A time or a time range that cannot be understood."""


class WhereError(UsageError):
    """A predicate that cannot be parsed or is not allowed."""


class TopicError(UsageError):
    """A topic, recording or field that does not exist, or a name that is ambiguous."""


class SourceError(HybridlogError):
    """An input file that gives nothing: missing, unreadable, empty, of the wrong kind."""

    exit_code = 3


class SourceDamagedError(HybridlogError):
    """An input file of which only a part could be read; that part is stored."""

    exit_code = 4


class StoreError(HybridlogError):
    """The store itself: no store, read-only, of a newer format, damaged."""

    exit_code = 5


class SegmentError(StoreError):
    """A segment of the store that cannot be read where it should be."""


class CatalogError(StoreError):
    """The catalog is damaged, or has lost what it should have. It is made again from the files."""


class IndexChangedError(StoreError):
    """Another process changes the index that was asked; asking again helps."""


class DatabaseError(HybridlogError):
    """MongoDB does not answer, refuses, or has died."""

    exit_code = 6


class DiskFullError(HybridlogError):
    """No space left where the store lies."""

    exit_code = 7


class AlreadyRecordedError(HybridlogError):
    """The content of this file is in the store already."""

    exit_code = 8


class MissingDependencyError(HybridlogError):
    """An optional package is needed; the message says how to install it."""

    exit_code = 9


class DefinitionError(HybridlogError):
    """A message definition that is missing, malformed or hostile.

    Messages of that type are stored and fetched exactly all the same; only their
    fields stay out of the index.
    """

    exit_code = 10


class PayloadError(HybridlogError):
    """A payload that does not fit its definition."""

    exit_code = 10
