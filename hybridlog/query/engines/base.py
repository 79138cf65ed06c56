"""The protocol of the engines, and what they answer with."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from enum import Enum, auto
from typing import TYPE_CHECKING, NamedTuple, Protocol

from hybridlog_storage.errors import HybridlogError

if TYPE_CHECKING:
    import numpy as np
    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.query.chunk_scan import ChunkTask, RowSelection
    from hybridlog.query.question import Part


class UndecidedError(HybridlogError):
    """An engine cannot tell what it was asked: another one has to."""


class Need(Enum):
    """What is asked of an engine."""

    COUNT = auto()
    """How many messages match."""
    OUTCOMES = auto()
    """For each message, whether it matches."""
    VALUES = auto()
    """Fields of the messages that match."""
    SELECTION = auto()
    """Where the messages that match lie."""


class Outcomes(NamedTuple):
    """What a predicate says of messages, in order of log time and arrival.

    Attributes:
        log_time: int64[n], ns.
        seq: int64[n], arrival numbers.
        holds: bool[n], whether each message matches.
    """

    log_time: NDArray[np.int64]
    seq: NDArray[np.int64]
    holds: NDArray[np.bool_]


class Values(NamedTuple):
    """Fields of messages that match, in order of log time and arrival.

    Attributes:
        log_time: int64[n], ns.
        seq: int64[n], arrival numbers.
        records: n rows, nested as the message is.
    """

    log_time: NDArray[np.int64]
    seq: NDArray[np.int64]
    records: pa.StructArray


class Engine(Protocol):
    """One way of answering a part of a question.

    All engines that can answer a part give the same answer. The planner asks `cost` first
    and calls only what the cost was asked for.
    """

    def cost(self, part: Part, need: Need, fields: Collection[str] | None = ()) -> float | None:
        """Seconds that the answer takes, about; None if the engine cannot give it.

        Args:
            part: The part of the question.
            need: What is wanted.
            fields: Paths of the fields wanted, for `Need.VALUES`; None for all.
        """

    def count(self, parts: Sequence[Part]) -> int:
        """Number of messages that match, in all of the parts."""

    def outcomes(self, part: Part) -> Iterator[Outcomes]:
        """For each message of the part's topic and time, whether it matches."""

    def values(self, part: Part, fields: Collection[str] | None) -> Iterator[Values]:
        """Fields of the messages that match."""

    def select(self, parts: Sequence[Part], tasks: Sequence[ChunkTask]) -> RowSelection:
        """Where the messages that match lie, in the chunks of some tasks."""


class Counting:
    """An engine that only counts."""

    def outcomes(self, part: Part) -> Iterator[Outcomes]:
        """Not answered here: `cost` says None."""
        raise NotImplementedError

    def values(self, part: Part, fields: Collection[str] | None) -> Iterator[Values]:
        """Not answered here: `cost` says None."""
        raise NotImplementedError

    def select(self, parts: Sequence[Part], tasks: Sequence[ChunkTask]) -> RowSelection:
        """Not answered here: `cost` says None."""
        raise NotImplementedError
