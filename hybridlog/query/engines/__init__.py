"""The protocol of the engines, the types of their answers, and what is common to them.

They answer parts of a question; all give the same answer.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from enum import Enum, auto
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeAlias, runtime_checkable

import numpy as np

from hybridlog_storage.errors import HybridlogError

if TYPE_CHECKING:
    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.query.chunk_scan import ChunkKey, ChunkTask, RowSelection
    from hybridlog.query.counters import Counters
    from hybridlog.query.question import Part
    from hybridlog.session import Session


class UndecidedError(HybridlogError):
    """An engine cannot decide; another engine has to."""


class Need(Enum):
    """Kind of answer requested from an engine."""

    COUNT = auto()
    """The number of matching messages."""
    OUTCOMES = auto()
    """For each message, True if it matches."""
    VALUES = auto()
    """Fields of the matching messages."""
    SELECTION = auto()
    """References to the matching messages."""


class MatchColumns(NamedTuple):
    """Result of a predicate for each message, in order of log time and arrival.

    Attributes:
        log_time: int64[n], ns.
        seq: int64[n], arrival numbers.
        holds: bool[n], True where the message matches.
    """

    log_time: NDArray[np.int64]
    seq: NDArray[np.int64]
    holds: NDArray[np.bool_]


class Values(NamedTuple):
    """Fields of matching messages, in order of log time and arrival.

    Attributes:
        log_time: int64[n], ns.
        seq: int64[n], arrival numbers.
        records: n rows, nested as the message is.
    """

    log_time: NDArray[np.int64]
    seq: NDArray[np.int64]
    records: pa.StructArray


Objects: TypeAlias = "tuple[NDArray[np.int64], Sequence[Mapping[str, object]]]"
"""Log times, ns, of messages in order, and the messages as `Codec.objects` makes them."""


class Engine(Protocol):
    """One way of answering a part of a question.

    All engines that can answer a part give the same answer. The planner calls `cost`
    first, and then only the methods for which `cost` returned a figure.
    """

    def cost(self, part: Part, need: Need, fields: Collection[str] | None = ()) -> float | None:
        """Estimated seconds for the answer; None if the engine cannot give it.

        Args:
            part: The part of the question.
            need: The kind of answer.
            fields: Paths of the fields wanted, for `Need.VALUES`; None for all.
        """

    def count(self, parts: Sequence[Part]) -> int:
        """Number of matching messages in all parts."""

    def outcomes(self, part: Part) -> Iterator[MatchColumns]:
        """For each message of the part's topic and time, whether it matches."""

    def values(self, part: Part, fields: Collection[str] | None) -> Iterator[Values]:
        """Fields of the matching messages."""

    def select(self, parts: Sequence[Part], tasks: Sequence[ChunkTask]) -> RowSelection:
        """References to the matching messages in the chunks of some tasks."""


@runtime_checkable
class Checking(Protocol):
    """An engine that knows only after reading columns whether they can decide."""

    def check(self, part: Part) -> int:
        """The count of one part.

        Raises:
            UndecidedError: The columns cannot decide.
            StoreError: They are damaged.
        """


class Counting:
    """An engine that only counts. The planner has a table of them."""

    def __init__(self, session: Session, counters: Counters) -> None:
        self._session = session
        self._counters = counters

    def cost(self, part: Part, need: Need, fields: Collection[str] | None = ()) -> float | None:
        """Estimated seconds for a count; None if it cannot give it."""
        raise NotImplementedError

    def count(self, parts: Sequence[Part]) -> int:
        """Number of matching messages in all parts."""
        raise NotImplementedError

    def outcomes(self, part: Part) -> Iterator[MatchColumns]:
        """Not supported: `cost` returns None."""
        raise NotImplementedError

    def values(self, part: Part, fields: Collection[str] | None) -> Iterator[Values]:
        """Not supported: `cost` returns None."""
        raise NotImplementedError

    def select(self, parts: Sequence[Part], tasks: Sequence[ChunkTask]) -> RowSelection:
        """Not supported: `cost` returns None."""
        raise NotImplementedError


def places_of(references: Any) -> NDArray[np.int64]:
    """Segment, chunk and payload offset of messages: int64[n, 3].

    Args:
        references: The column `ref` of a table.
    """
    columns = [references.field(n).to_numpy(zero_copy_only=False) for n in ("seg", "chunk", "off")]
    return np.stack(columns, axis=1).astype(np.int64)


def offsets_by_chunk(
    recording: str, places: NDArray[np.int64]
) -> dict[ChunkKey, NDArray[np.int64]]:
    """Payload offsets of messages by chunk, sorted.

    Args:
        recording: Id of the recording.
        places: As of `places_of`, in any order.
    """
    places = places[np.lexsort((places[:, 2], places[:, 1], places[:, 0]))]
    edges = np.flatnonzero(np.any(places[1:, :2] != places[:-1, :2], axis=1)) + 1
    return {
        (recording, int(group[0, 0]), int(group[0, 1])): group[:, 2]
        for group in np.split(places, edges)
        if len(group)
    }
