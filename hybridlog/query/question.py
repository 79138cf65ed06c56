"""The values that describe a question: `Question`, the `Part`s it is split into, its cost."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from hybridlog.query.times import TimeLike
from hybridlog.schema.states import State, encoding_of, state_of
from hybridlog_storage.cache import lazy
from hybridlog_storage.times import BEGIN, END, span_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.intervals import Intervals
    from hybridlog.query.predicate.tree import Predicate
    from hybridlog.schema.codec import Codec
    from hybridlog_storage.catalog import ChannelStats, RecordingEntry
    from hybridlog_storage.messages import Batch, Channel
    from hybridlog_storage.segments.chunk import StoredChunk

Clock = Literal["log", "publish", "header"]
Span = tuple[int, int]
"""`[begin, end)`, nanoseconds."""


class Question(Struct, frozen=True):
    """The content of a question. Immutable, hashable and picklable.

    Attributes:
        topics: Full names of topics.
        recordings: Ids of recordings; None for every recording that has a topic.
        bounds: Time range `[begin, end)` as given; None for all times.
        clock: The clock that `bounds` refers to.
        every: Take every n-th message of each topic.
        reverse: Latest message first.
        fields: Field paths for tables; None for all.
        names_recording: Tables have the column `recording` even if there is only one.
        during: Intervals of log time that messages must lie in; None for all times.
        frame: Frame of points and poses in the answer; None for that of each message.
        tf_topics: Topics whose transforms lead to that frame; empty for those of each tree.
    """

    topics: tuple[str, ...]
    recordings: tuple[str, ...] | None = None
    bounds: tuple[TimeLike | None, TimeLike | None] | None = None
    clock: Clock = "log"
    predicate: Predicate | None = None
    limit: int | None = None
    every: int = 1
    reverse: bool = False
    fields: tuple[str, ...] | None = None
    names_recording: bool = False
    during: Intervals | None = None
    frame: str | None = None
    tf_topics: tuple[str, ...] = ()

    @property
    def returns_all(self) -> bool:
        """True if every matching message is in the answer: neither `limit` nor `every`."""
        return self.limit is None and self.every == 1

    @property
    def is_unbounded(self) -> bool:
        """True if the question covers all times: neither `between` nor `during`."""
        return self.bounds is None and self.during is None

    @property
    def is_by_log_time(self) -> bool:
        """True if the time range, if any, refers to log time."""
        return self.bounds is None or self.clock == "log"

    def within(self, intervals: Intervals) -> Question:
        """The question about messages in some intervals alone."""
        common = intervals if self.during is None else self.during.common(intervals)
        return replace(self, during=common.merged())


class RecordedChannel(Struct, frozen=True, dict=True):
    """One channel of one recording."""

    recording: RecordingEntry
    channel_id: int
    channel: Channel
    stats: ChannelStats

    @lazy
    def codec(self) -> Codec:
        """Decodes its payloads; made when first used."""
        from hybridlog.schema.codecs import codec_for

        return codec_for(self.channel)

    def arrow_type(self, fields: Collection[str] | None = None) -> Any:
        """Arrow type of its messages, or of some fields, as far as a definition fixes it."""
        return _arrow_type(self.codec, None if fields is None else frozenset(fields))

    @property
    def is_reduced(self) -> bool:
        """True if its messages have their fields but not their payloads."""
        return self.state is not State.WHOLE

    @property
    def encoding(self) -> str:
        """The encoding of its payloads, which may be gone."""
        return encoding_of(self.channel.message_encoding, self.channel.metadata)

    @property
    def state(self) -> State:
        """The state of its messages; some may be unreadable."""
        return state_of(self.channel.message_encoding)


class Part(Struct, frozen=True, eq=False, dict=True):
    """The part of a question for one topic of one recording.

    Attributes:
        predicate: What messages satisfy, a range of another clock than the log's among it.
        windows: int64[n, 2], `[begin, end)` of log time, disjoint, in order; None for all times.
    """

    recording: RecordingEntry
    topic: str
    channels: tuple[RecordedChannel, ...]
    predicate: Predicate | None
    windows: NDArray[np.int64] | None = None

    @property
    def messages(self) -> int:
        """Messages of the topic in the recording, at any time."""
        return sum(channel.stats.messages for channel in self.channels)

    @property
    def needs_index(self) -> bool:
        """True if the predicate has MongoDB filters."""
        return self.predicate is not None and bool(self.predicate.filters)

    @property
    def has_fields(self) -> bool:
        """True if all of its channels have fields: not without a definition, for example."""
        return all(channel.codec.indexed for channel in self.channels)

    @lazy
    def field_types(self) -> Mapping[str, str] | None:
        """Types of the fields by path; None where a definition does not fix them."""
        return field_types(tuple(one for one in self.channels if one.codec.indexed))

    @property
    def log_windows(self) -> NDArray[np.int64]:
        """int64[n, 2]: the log time of the part."""
        return windows_in(None) if self.windows is None else self.windows

    @property
    def log_span(self) -> Span:
        """From the first of `log_windows` to the end of the last one, ns; empty without any."""
        windows = self.log_windows
        return (int(windows[0, 0]), int(windows[-1, 1])) if len(windows) else (0, 0)

    @lazy
    def span(self) -> Span:
        """Log time of the topic's messages in the recording, ns; empty without any."""
        ends = [end for one in self.channels for end in (one.stats.first, one.stats.last)]
        known = [end for end in ends if end is not None]
        return span_of(min(known), max(known)) if known else (0, 0)


class Counters(Struct):
    """The cost of an answer, and what is missing from it.

    Attributes:
        messages: Messages in the answer.
        latched: Latched messages in front of it, which are not in `messages`.
        frames: Frames of video in front of it, from the key frame on; not in `messages`.
        payload_bytes: Bytes of their payloads.
        bytes_read: Bytes read from segments and tables.
        chunks_read: Chunks read and decompressed.
        documents_read: Index documents received from MongoDB.
        reduced: Messages left out because only their fields are there.
        expired: Those of them whose payloads were deleted to make room.
        not_copied: Those of them whose payloads were not copied yet.
        lacking: Messages in the answer whose arrays are null, since only summaries are left.
        unreadable: Messages of the predicate's topics that do not fit their definition, or lack
            arrays that it asks for.
        without_arrays: Those of them that lack arrays, since their payloads are gone.
        not_indexed: Names of recordings with the number of messages that the index lacks, if it
            has answered; several.
        no_transform: The frame asked for with a reason why points or poses are not in it, and
            the number of messages; several.
        of_frames: Sentences about the transforms that were used.
        elapsed_s: Wall time, seconds.
    """

    messages: int = 0
    latched: int = 0
    frames: int = 0
    payload_bytes: int = 0
    bytes_read: int = 0
    chunks_read: int = 0
    documents_read: int = 0
    reduced: int = 0
    expired: int = 0
    not_copied: int = 0
    lacking: int = 0
    unreadable: int = 0
    without_arrays: int = 0
    not_indexed: tuple[tuple[str, int], ...] = ()
    no_transform: tuple[tuple[str, int], ...] = ()
    of_frames: tuple[str, ...] = ()
    elapsed_s: float = 0.0

    @property
    def unindexed(self) -> int:
        """Messages that the index lacks, if it has answered."""
        return sum(number for _, number in self.not_indexed)

    def reset(self) -> None:
        """Set every counter to zero."""
        for name, value in zip(self.__struct_fields__, self.__struct_defaults__, strict=True):
            setattr(self, name, value)

    def add(self, other: Counters) -> None:
        """Add the counts of a part of the answer; the wall time is unchanged."""
        for name in self.__struct_fields__:
            if name != "elapsed_s":
                setattr(self, name, getattr(self, name) + getattr(other, name))

    def add_chunk(self, chunk: StoredChunk) -> None:
        """Count a chunk that was read."""
        self.chunks_read += 1
        self.bytes_read += chunk.place.length + chunk.place.trailer

    def add_messages(self, batch: Batch) -> None:
        """Count messages of the answer."""
        self.messages += len(batch)
        self.payload_bytes += batch.payload_bytes

    def leave_out(self, messages: int, state: State) -> None:
        """Count messages that are left out since their payloads are gone."""
        self.reduced += messages
        self.expired += messages * (state == "expired")
        self.not_copied += messages * (state == "not_copied")

    @contextmanager
    def timed(self) -> Iterator[None]:
        """Set every counter to zero and measure the wall time of the block."""
        self.reset()
        started = time.monotonic()
        try:
            yield
        finally:
            self.elapsed_s = time.monotonic() - started


@lru_cache(maxsize=256)
def _arrow_type(codec: Codec, fields: frozenset[str] | None) -> Any:
    from hybridlog.schema.codec import no_messages

    return codec.columns_of(no_messages(), fields).arrow().type


def windows_in(windows: NDArray[np.int64] | None, bounds: Span = (BEGIN, END)) -> NDArray[np.int64]:
    """int64[n, 2]: what windows (None for all times) and bounds have in common."""
    found = np.array([bounds], np.int64) if windows is None else np.clip(windows, *bounds)
    return found[found[:, 1] > found[:, 0]]


def field_types(channels: tuple[RecordedChannel, ...]) -> dict[str, str] | None:
    """Types of the fields of some channels, by path; None where no definition fixes them."""
    return _field_types(tuple(dict.fromkeys(channel.codec for channel in channels)))


@lru_cache(maxsize=256)
def _field_types(codecs: tuple[Codec, ...]) -> dict[str, str] | None:
    types: dict[str, str] = {}
    for codec in codecs:
        paths = codec.paths()
        for path in paths:
            types[path.path] = _either(types.get(path.path), path.type)
        if not paths:
            return None
    return types or None


def _either(one: str | None, other: str) -> str:
    """The type of a field in two definitions: arrays of two lengths are of any; else the later."""
    base, _, length = other.partition("[")
    if length and one is not None and one != other and one.startswith(f"{base}["):
        return f"{base}[]"
    return other
