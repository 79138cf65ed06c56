"""Reports of maintenance: repairs, progress, and how far a follower is."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from msgspec import Struct, field

if TYPE_CHECKING:
    from hybridlog_storage.errors import DatabaseError
    from hybridlog_storage.mongo.database import Database
    from hybridlog_storage.segments.walk import Recovered

Progress = Callable[[str, int, int], None]
"""Called with the recording's name, bytes done and bytes in all."""


def reporter(
    progress: Progress | None, name: str, total: int, before: int = 0
) -> Callable[[int], None]:
    """Reports the bytes done of a recording, behind those `before`."""
    return lambda done: None if progress is None else progress(name, before + done, total)


class Repaired(Struct, frozen=True):
    """A repair.

    Attributes:
        recording: Name of the recording.
        place: File or other subject.
        done: What was done.
    """

    recording: str
    place: str
    done: str


class RepairReport(Struct):
    """Repairs of a store; recordings by name.

    Attributes:
        recovered: Segments that a crash left open.
        indexed: Recordings whose index was behind, and the number of missing chunks.
        removed: Recordings whose removal was finished, or whose files are gone.
        unreadable: Ids of recordings that could not be repaired, and the reason.
    """

    recovered: dict[str, list[Recovered]] = field(default_factory=dict)
    indexed: dict[str, int] = field(default_factory=dict)
    removed: list[str] = field(default_factory=list)
    unreadable: dict[str, str] = field(default_factory=dict)


class ArraysOfTopic(Struct):
    """The result of `Index.arrays` for a topic.

    Attributes:
        topic: Full name.
        recordings: Names of the recordings whose tables were made anew.
        bytes: Bytes of all tables of its message type now; topics and recordings share files.
        left: Names of recordings whose tables are as before: they are being written, or
            cannot be read.
    """

    topic: str
    recordings: list[str] = field(default_factory=list)
    bytes: int = 0
    left: list[str] = field(default_factory=list)


class Followed(NamedTuple):
    """How far a follower is.

    `is_wanted` tells whether the recording gets documents. `read` and `indexed` count messages, and
    `missed` those that the index lacks after a `failure` of the database.
    """

    is_wanted: bool
    read: int = 0
    indexed: int = 0
    missed: int = 0
    failure: DatabaseError | None = None


class IndexTarget(Struct, frozen=True):
    """The database for the index documents of a recording.

    Attributes:
        database: The index; None if it is unavailable now, or the recording gets none.
        failure: Why it is unavailable now; None if it is not, or the recording gets none.
    """

    database: Database | None = None
    failure: DatabaseError | None = None

    @property
    def is_wanted(self) -> bool:
        """True if the recording gets documents, now or later."""
        return self.database is not None or self.failure is not None

    @property
    def without(self) -> str:
        """The end of a sentence about a MongoDB that is unavailable."""
        return "so the index is made later" if self.is_wanted else "so there is no index"
