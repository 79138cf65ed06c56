"""The context of the view's routes: the open store, bounds on the work, JSON answers."""

from __future__ import annotations

import json
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from starlette.responses import Response
from starlette.routing import Route

from hybridlog.drawing.density_cache import DensityCache
from hybridlog.drawing.match_cache import MatchCache
from hybridlog.export.slice_cache import SliceCache
from hybridlog.losses import extent_of
from hybridlog.view.asked import Asked
from hybridlog.view.sql_process import SqlProcess
from hybridlog_storage.errors import HybridlogError, TopicError
from hybridlog_storage.lazy import lazy

if TYPE_CHECKING:
    from starlette.requests import Request

    from hybridlog.query.query import Query
    from hybridlog.store import Store
    from hybridlog_storage.catalog import RecordingEntry

MAX_WORKING: Final = 4
"""Number of answers that are worked out at once; others wait for their turn."""

SQL_MEMORY: Final = 512 << 20
"""Bytes that DuckDB may use for all queries together."""
REFRESH_S: Final = 2.0
"""Least time between two looks for new recordings."""
REFRESH_SHARE: Final = 0.1
"""Greatest share of the time that is spent on these looks, in stores of many recordings."""


class Context:
    """The store that is shown.

    Args:
        store: An open store. It is only read.

    Attributes:
        store: That store.
    """

    def __init__(self, store: Store) -> None:
        self.store = store
        self._refreshing = threading.Lock()
        self._next_look = time.monotonic() + REFRESH_S
        self._working = threading.BoundedSemaphore(MAX_WORKING)

    @lazy
    def densities(self) -> DensityCache:
        """Counts of messages by pixel."""
        return DensityCache(self.store.session)

    @lazy
    def matches(self) -> MatchCache:
        """Matches of the last questions."""
        return MatchCache()

    @lazy
    def sql(self) -> SqlProcess:
        """Answers SQL."""
        return SqlProcess(self.store)

    @lazy
    def slices(self) -> SliceCache:
        """MCAP files of selections."""
        return SliceCache()

    @contextmanager
    def turn(self) -> Iterator[None]:
        """Wait until few enough answers are being worked out, and be one of them.

        The answer is about the recordings of one moment.
        """
        with self._working, self.store.at_one_moment():
            yield

    def refresh(self) -> None:
        """See what other processes have recorded since, unless the last look was just now."""
        with self._refreshing:
            begun = time.monotonic()
            if begun >= self._next_look:
                self.store.refresh()
                self.store.session.snapshot()
                ended = time.monotonic()
                self._next_look = ended + max(REFRESH_S, (ended - begun) / REFRESH_SHARE)

    def recording(self, asked: Asked) -> RecordingEntry:
        """The recording that the parameter `recording` names by its label or id.

        Raises:
            TopicError: There is none.
            UsageError: The parameter is missing.
        """
        return self.store.entry(asked.text("recording"))

    def query(self, recording: RecordingEntry, *topics: str) -> Query:
        """A query about topics, by their full names, of one recording.

        Raises:
            TopicError: The recording has no such topic.
        """
        known = {channel.topic for channel in recording.channels}
        for topic in topics:
            if topic not in known:
                raise TopicError(f"{recording.label} has no topic {topic!r}.")
        return self.store.query(topics, [recording.id])

    def topic(self, asked: Asked) -> tuple[RecordingEntry, Query]:
        """The recording, and a query about its topic that the parameter `topic` names.

        Raises:
            TopicError: No such recording or topic exists.
            UsageError: A parameter is missing or out of bounds.
        """
        recording = self.recording(asked)
        return recording, self.query(recording, asked.text("topic"))


def start_of(recording: RecordingEntry) -> int:
    """The time that offsets count from, ns: of the first message, else of the recording."""
    span = recording.span
    return recording.created if span is None else span[0]


def extent(recording: RecordingEntry) -> tuple[int, int]:
    """Log time `[begin, end)` of a recording, ns; empty when it was made if it has no messages."""
    begin, end = extent_of(recording)
    return (begin, end) if begin < end else (recording.created, recording.created)


Answer: TypeAlias = "Callable[[Context, Asked], Any]"
"""Works out an answer: plain values, which become JSON, or a response."""


def route(path: str, answer: Answer) -> Route:
    """A route that answers in a thread, when it is its turn.

    Args:
        path: Path below the token.
        answer: Works out the answer.
    """

    def endpoint(request: Request) -> Response:
        context: Context = request.app.state.context
        try:
            with context.turn():
                tag = request.headers.get("if-none-match")
                found = answer(context, Asked(request.query_params, tag))
            return found if isinstance(found, Response) else json_response(found)
        except HybridlogError as error:
            return error_response(error)

    return Route(path, endpoint, name=path)


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
