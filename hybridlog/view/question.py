"""A question that the page asks: its query, and the same as a command line and as Python."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from msgspec import Struct

from hybridlog.query.predicate.tokens import MAX_TEXT
from hybridlog.query.times import format_time
from hybridlog.record.losses import extent_of

if TYPE_CHECKING:
    from hybridlog.query.query import Query
    from hybridlog.query.question import Span
    from hybridlog.store import Store
    from hybridlog.view.context import Context, RequestParams
    from hybridlog_storage.catalog import RecordingEntry

MAX_TOPICS: Final = 200
"""Greatest number of topics that are named; without any, all are meant."""
_EVERY_TOPIC: Final = "**"
_NO_NAME: Final = re.compile(r"[^\w.+-]+")


class PageQuestion(Struct, frozen=True):
    """A question about one recording.

    Attributes:
        topics: Full names; none for all.
        where: Predicate, empty for every message.
        within: Greatest distance in time of messages of other topics, empty without any.
        span: Log time `[begin, end)`, ns; None for all of it.
    """

    store: Store
    recording: RecordingEntry
    topics: tuple[str, ...]
    where: str
    within: str
    span: Span | None

    def query(self) -> Query:
        """Its messages."""
        query = self.store.query(self._topics(), [self.recording.id])
        if self.span is not None:
            # First, so that conditions on other topics are asked in this range only.
            query = query.between(*self.span)
        if self.where:
            query = query.where(self.where, self.within or None)
        return query

    def told(self) -> dict[str, Any]:
        """The number of its messages, losses and remarks, its command line, file and program."""
        query = self.query()
        count = query.count()
        found = query.completeness()
        return {
            "count": count,
            "lost": found.describe(count) if found.has_losses else None,
            "remarks": found.sentences,
            "python": self.python(),
            "command": self.command(),
            "name": self.file_name(),
        }

    def command(self) -> str:
        """The command line that writes it to a file of `file_name`."""
        words = ["hybridlog", "fetch", "--store", self.store.directory.place]
        words += ["-r", self.recording.name]
        for topic in self.topics or [_EVERY_TOPIC]:
            words += ["-t", topic]
        if self.span is not None:
            words += ["--between", *map(format_time, self.span)]
        if self.where:
            words += ["--where", self.where]
        if self.within:
            words += ["--within", self.within]
        return shlex.join([*words, "-o", self.file_name()])

    def python(self) -> str:
        """A program that asks the same."""
        recordings = f"store.recordings({self.recording.name!r})"
        topics = ", ".join(map(repr, self.topics))
        steps = [f"{recordings}.topic({topics})" if topics else f"{recordings}.all_topics()"]
        if self.span is not None:
            steps.append(f".between({self.span[0]}, {self.span[1]})")
        if self.where:
            within = f", within={self.within!r}" if self.within else ""
            steps.append(f".where({self.where!r}{within})")
        lines = "".join(f"\n        {step}" for step in steps)
        body = (
            f"    messages = ({lines}\n    )\n"
            "    print(messages.count())\n"
            "    for message in messages.limit(10):\n"
            "        print(message.log_time_ns, message.topic)\n"
        )
        return program(self.store, body)

    def file_name(self) -> str:
        """The name of its file: recording and range."""
        begin, end = self.span or extent_of(self.recording)
        times = "_".join(format_time(time).replace(":", "") for time in (begin, end))
        return f"{_NO_NAME.sub('_', self.recording.name)}_{times}.mcap"

    def _topics(self) -> Sequence[str]:
        return self.topics or sorted({channel.topic for channel in self.recording.channels})


def question_of(context: Context, params: RequestParams) -> PageQuestion:
    """The question of a request, about all times.

    It has the parameters `recording`, `topic`, repeated, `where` and `within`.
    """
    recording = context.recording(params)
    topics = tuple(dict.fromkeys(params.texts("topic", most=MAX_TOPICS)))
    context.query(recording, *topics)
    where = params.text("where", "", longest=MAX_TEXT).strip()
    within = params.text("within", "", longest=64)
    return PageQuestion(context.store, recording, topics, where, within, None)


def program(store: Store, body: str) -> str:
    """A program that opens a store; `body` is indented."""
    path = store.directory.place
    return f"import hybridlog as hl\n\nwith hl.open({path!r}) as store:\n{body}"
