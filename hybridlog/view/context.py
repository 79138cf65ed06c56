"""The context of the view's routes: the open store, parameters, bounds on work, JSON answers."""

from __future__ import annotations

import asyncio
import json
import struct
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from copy import copy
from functools import wraps
from inspect import signature
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeAlias, get_origin, get_type_hints

from msgspec import Meta, Struct, ValidationError, convert, defstruct
from msgspec.structs import asdict
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response
from starlette.routing import Route

from hybridlog.query.answers.current import next_time
from hybridlog.query.predicate.parser import MAX_TEXT
from hybridlog.query.times import TIME_LIMIT
from hybridlog_storage.errors import (
    HybridlogError,
    ResourceError,
    TimeError,
    TopicError,
    UsageError,
)
from hybridlog_storage.stopping import GivenUpError, held, until_given_up
from hybridlog_storage.times import END, span_of

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from starlette.datastructures import QueryParams
    from starlette.requests import Request

    from hybridlog.message import Message
    from hybridlog.query.query import Query
    from hybridlog.store import Store
    from hybridlog_storage.catalog import RecordingEntry, RecordingSummary


MAX_WORKING: Final = 4
"""Number of answers that are worked out at once; others wait for their turn."""

REFRESH_S: Final = 2.0
"""Time from one look for new recordings to the next, at least."""


MAX_OFFSET: Final = TIME_LIMIT - 1
"""Greatest time since the start of a recording, ns."""
MAX_PIXELS: Final = 8192
"""Greatest width that is drawn."""

# Types of parameters; times are since the start of the recording, ns.
Text: TypeAlias = Annotated[str, Meta(max_length=1024)]
Question: TypeAlias = Annotated[str, Meta(max_length=MAX_TEXT)]
Offset: TypeAlias = Annotated[int, Meta(ge=-MAX_OFFSET, le=MAX_OFFSET)]
Pixels: TypeAlias = Annotated[int, Meta(ge=1, le=MAX_PIXELS)]
Seq: TypeAlias = Annotated[int, Meta(ge=-1, le=END)]


def moment_of(start: int, offset: int) -> int:
    """A time since the start, ns, as one since 1970, cut to what is a time."""
    return min(max(start + offset, 0), TIME_LIMIT - 1)


def part_of(start: int, begin: int, end: int) -> tuple[int, int]:
    """A range of times since the start, ns, as one since 1970, cut to what is a time; not empty."""
    if end <= begin:
        raise UsageError("end is greater than begin.")
    last = TIME_LIMIT - 1
    return min(max(start + begin, 0), last - 1), min(max(start + end, 1), last)


class Context:
    """The store that is shown.

    Attributes:
        store: That store; at one moment while an answer is worked out.
        turns: Held by each answer that is worked out.
    """

    def __init__(self, store: Store) -> None:
        self.store = store
        self.turns = threading.BoundedSemaphore(MAX_WORKING)
        self._looking, self._looked = threading.Lock(), time.monotonic()

    def of_now(self) -> Context:
        """The same context for an answer, whose store is of the moment that begins now."""
        with self._looking:  # for what other processes have done since
            if time.monotonic() >= self._looked + REFRESH_S:
                self.store.refresh()
                self._looked = time.monotonic()
        found = copy(self)
        found.store = self.store.snapshot()
        return found

    def query(self, recording: RecordingEntry, *topics: str) -> Query:
        """A query about topics, by their full names, of one recording."""
        known = {channel.topic for channel in recording.channels}
        for topic in topics:
            if topic not in known:
                raise TopicError(f"{recording.name} has no topic {topic!r}.")
        return self.store.query(topics, [recording.id])

    def topic(self, recording: str, topic: str) -> tuple[RecordingEntry, Query]:
        """A recording by its id or name, and a query about a topic of it."""
        entry = self.store.entry(recording)
        return entry, self.query(entry, topic)


def start_of(recording: RecordingEntry | RecordingSummary) -> int:
    """The time that offsets count from, ns: of the first message, else of the recording."""
    span = recording.span
    return recording.created if span is None else span[0]


def extent(recording: RecordingEntry) -> tuple[int, int]:
    """Log time `[begin, end)` of a recording, ns; empty when it was made if it has no messages."""
    begin, end = recording.extent
    return (begin, end) if begin < end else (recording.created, recording.created)


def route(
    path: str, turns: threading.Semaphore | None = None
) -> Callable[[Callable[..., Any]], Route]:
    """Makes a route of a function that works out an answer: plain values, or a response.

    It takes the context, and the parameters of the request by the names and types of its own. It
    runs in a thread when it is its turn, of the context's unless others are given, and stops when
    the client has gone. The path is that below the token.
    """

    def made(answer: Callable[..., Any]) -> Route:
        taken = _taken_by(answer)

        def answered(request: Request, given_up: threading.Event) -> Response:
            context: Context = request.app.state.context
            try:
                given = taken(request.query_params)
                with until_given_up(given_up), held(turns or context.turns):
                    found = answer(context.of_now(), **given)
                return found if isinstance(found, Response) else json_response(found)
            except HybridlogError as error:
                return error_response(error)
            except GivenUpError:
                return error_response(ResourceError("The query was stopped."))

        @wraps(answer)
        async def endpoint(request: Request) -> Response:
            given_up = threading.Event()
            watching = asyncio.create_task(_wait_until_gone(request, given_up))
            try:
                return await run_in_threadpool(answered, request, given_up)
            finally:
                given_up.set()
                watching.cancel()
                with suppress(asyncio.CancelledError):
                    await watching

        return Route(path, endpoint, name=path)

    return made


def _taken_by(answer: Callable[..., Any]) -> Callable[[QueryParams], dict[str, Any]]:
    """What takes the parameters of an answer from a request; wrong and missing ones are refused."""
    kinds = get_type_hints(answer, include_extras=True)
    _, *own = signature(answer).parameters.values()
    fields = [
        (one.name, kinds[one.name], *([] if one.default is one.empty else [one.default]))
        for one in own
    ]
    form = defstruct("Parameters", fields, kw_only=True)
    lists = {name for name, kind in get_type_hints(answer).items() if get_origin(kind) is list}

    def taken(given: QueryParams) -> dict[str, Any]:
        values = {name: given.getlist(name) if name in lists else given[name] for name in given}
        try:
            return asdict(convert(values, form, strict=False))
        except ValidationError as error:
            raise UsageError(f"{error}.") from error

    return taken


async def _wait_until_gone(request: Request, given_up: threading.Event) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
    given_up.set()


def json_response(values: Any, status: int = 200) -> Response:
    """Plain values as JSON."""
    text = json.dumps(values, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return Response(text, status, media_type="application/json")


def error_response(error: HybridlogError) -> Response:
    """An error that hybridlog raised on purpose: its text, which may have a line with a caret."""
    return json_response({"error": str(error)}, 404 if isinstance(error, TopicError) else 400)


def broken_response(_: Request, error: Exception) -> Response:
    """An error in hybridlog itself: its trace goes to standard error, not to the page.

    An error that was raised on purpose comes here if the answer had begun: its text is enough.
    """
    if isinstance(error, HybridlogError):
        print(f"hybridlog: {error}", file=sys.stderr, flush=True)  # noqa: T201
    else:
        traceback.print_exception(error, file=sys.stderr)
    return json_response({"error": "hybridlog failed; its terminal has the details."}, 500)


class Current(Struct, frozen=True):
    """The message that is current at a time: the last one not after it; None if there is none.

    Attributes:
        time: Its log time, ns since the start of the recording; None without a message.
        until: Log time of the next message; None if no later one is known. Both are texts, as the
            page has no integers of 64 bits.
    """

    message: Message | None
    time: str | None
    until: str | None


def current(context: Context, recording: str, topic: str, at: int, seq: int = END) -> Current:
    """The message of a topic that is current at a time since the start of the recording, ns.

    Of several messages at that time, it is the last one whose arrival number is at most `seq`.
    """
    entry, query = context.topic(recording, topic)
    start = start_of(entry)
    moment = moment_of(start, at)
    message = _message(query, moment, seq)
    # Of messages with the same time, the last one is current: the next one is later.
    later = moment if message is None else message.log_time_ns + 1
    until = next_time(context.store.session, entry, query.topics[0], later)
    return Current(
        message,
        None if message is None else str(message.log_time_ns - start),
        None if until is None else str(until - start),
    )


def _message(query: Query, moment: int, seq: int) -> Message | None:
    if seq < END:
        with suppress(TimeError):
            beside = query.between(*span_of(moment, moment)).where(f"_meta.seq <= {seq}")
            found = next(iter(beside.reverse().limit(1)), None)
            if found is not None:
                return found
        moment -= 1
    with suppress(TopicError):  # there is none yet
        return query.at(moment)
    return None


_ALIGNED = 8


def packed_response(header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> Response:
    """Plain values, and arrays of numbers by name; those of wide numbers come first.

    Behind the length of the header (uint32, little-endian, as all numbers) is the header, JSON
    with spaces up to a multiple of 8 bytes, then array after array.
    """
    ordered = sorted(arrays.items(), key=lambda one: -one[1].dtype.itemsize)
    described = [
        {"name": name, "type": array.dtype.name, "count": array.size} for name, array in ordered
    ]
    values = {**header, "arrays": described}
    text = json.dumps(values, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-(len(text) + 4) % _ALIGNED)
    parts = [struct.pack("<I", len(text)), text]
    parts += [
        array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes() for _, array in ordered
    ]
    return Response(b"".join(parts), media_type="application/octet-stream")
