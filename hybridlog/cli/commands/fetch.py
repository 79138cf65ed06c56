"""`hybridlog fetch`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import click

from hybridlog.cli import output
from hybridlog.cli.answers import (
    SCREEN,
    SCREEN_ROWS,
    Tabular,
    format_option,
    latched,
    output_option,
    write_answer,
    write_following,
)
from hybridlog.cli.options import (
    Filtered,
    InFrame,
    NoLatched,
    command,
    option,
    parse_fields,
    query_of,
)
from hybridlog.formats import OUTPUTS, formats_of
from hybridlog_storage.errors import TopicError, UsageError
from hybridlog_storage.stopping import at_safe_points

if TYPE_CHECKING:
    from hybridlog.query.query import Query
    from hybridlog.store import Store

_FORMATS = formats_of()


class _Choices(Filtered, InFrame, Tabular, NoLatched):
    needs_topic: ClassVar[bool] = True
    formats: ClassVar[Sequence[str]] = _FORMATS

    @property
    def usual(self) -> tuple[str, str]:  # type: ignore[override]
        """The format on a terminal, and elsewhere."""
        return "jsonl" if self.follow else SCREEN, "jsonl"

    clock: str = option(
        "The clock of --between.", type=click.Choice(["log", "publish", "header"]), default="log"
    )
    at: str | None = option(
        "Only the message that was current at this time.",
        "T",
        excludes=("between", "last", "limit", "every", "reverse", "clock", "follow"),
    )
    every: int = option("Only every n-th message.", "N", type=click.IntRange(min=1), default=1)
    reverse: bool = option("Latest first.")
    follow: bool = option(
        "Of running recordings: print messages as they come, from now on or from the "
        "beginning of --between, until the recordings end or Ctrl-C.",
        excludes=("as_json", "output", "reverse", "count", "strict", "frame"),
    )
    fields: str | None = option("Only these fields, with commas between them.", "A,B.C")
    within: str | None = option(
        "Greatest distance in time of messages of other topics in --where "
        "'/odom: twist.twist.linear.x > 0.5'.",
        "DURATION",
        needs=("where",),
        excludes=("before", "after"),
    )
    before: str | None = option(
        "With such a --where, in place of --within: from this long before each match on, "
        "such as 5min.",
        "DURATION",
        needs=("where",),
    )
    after: str | None = option(
        "With such a --where, in place of --within: until this long after each match.",
        "DURATION",
        needs=("where",),
    )
    count: bool = option("Only print how many.", excludes=("output", "form", "frame"))
    form: str | None = format_option(_FORMATS)
    output: Path | None = output_option(
        "Write to this file (raw: a directory; png and jpg: a directory, or one picture)"
    )

    def check(self) -> None:
        """Refuse what makes no sense, or cannot be written."""
        assert self.topics or self.topic_type
        form = self.to_form
        as_it_came = form in OUTPUTS and OUTPUTS[form].content in {"log", "pictures", "video"}
        if self.frame is not None and (as_it_came or form == "raw"):
            raise UsageError(f"{form} has messages as they came: --in-frame is for tables and ply.")
        if self.follow and not (form in OUTPUTS and OUTPUTS[form].is_text and form != "json"):
            raise UsageError(f"--follow prints lines, such as jsonl or csv: {form} has an end.")
        if not self.count:
            super().check()


@command(_Choices)
def fetch_command(choices: _Choices) -> None:
    """Fetch messages by topic, time and content.

    Without --format and -o: a table on a terminal, JSON lines elsewhere. What the answer may
    lack is printed on standard error.
    """
    with choices.opened(snapshot=not choices.follow) as store:
        query = _query(store, choices)
        if choices.follow:
            _follow(query, choices)
            return
        if choices.at is not None:
            from hybridlog.query.query import at_time

            try:
                query = at_time(query, choices.at)
            except TopicError:
                before = query.between("start", choices.at)
                output.remarks(before.completeness().sentences)
                raise
        if choices.strict:
            query.completeness().check(payloads=not choices.count)
        if choices.count:
            count, more = query.count(), ""
            completeness = query.completeness()
            if choices.strict:
                completeness.check()
            output.say(str(count))
            if completeness.has_losses:
                more = completeness.describe(count, query.question.limit)
        else:
            query = _answer(query, choices)
            more = latched(query.counters).removeprefix(" and ")
        sys.stdout.flush()
        output.remarks(filter(None, (*query.completeness().sentences, more)))


def _answer(query: Query, choices: _Choices) -> Query:
    """Print the first messages of a query, or write all; gives the query that was answered.

    Strict: nothing is written if a pose has no transform, which shows only at the end.
    """
    form, strict = choices.to_form, choices.strict
    if form != SCREEN:
        from hybridlog.formats.slices import Front

        is_one = choices.at is not None and form != "mp4"  # the answer is one message
        front = Front(latched=not (choices.no_latched or is_one))
        write_answer(query, form, choices.place, front=front, strict=strict)
        return query
    from hybridlog.query.query import tables_of

    answered = query if query.question.limit is not None else query.limit(SCREEN_ROWS + 1)
    completeness = answered.completeness if strict else None
    choices.answer(tables_of(answered), completeness=completeness, noun="message")
    return answered


def _follow(query: Query, choices: _Choices) -> None:
    """Print messages as they come, then what they may lack."""
    from hybridlog.cli.commands.ls import status_text
    from hybridlog.query.query import Query

    following = query.follow(*(choices.topics or query.topics))
    try:
        with at_safe_points():
            write_following(following, choices.to_form)
    finally:
        now = query.source.now()
        asked = Query(now, following.question)
        asked.counters = query.counters
        ended = (one for one in now.summaries_of(asked.question) if one.status != "open")
        output.remarks(asked.completeness().sentences)
        output.remarks(f"{one.name} has ended: {status_text(one)}." for one in ended)


def _query(store: Store, choices: _Choices) -> Query:
    from hybridlog.query.predicate.parser import is_filter, parse

    query = choices.bounded(query_of(store, choices.named(store), choices.choice))
    query = query.clock(choices.clock)
    near: str | tuple[str, str] | None = choices.within
    if (choices.before, choices.after) != (None, None):
        near = choices.before or "0s", choices.after or "0s"
    across = [not is_filter(one) and parse(one).is_across for one in choices.where]
    if near is not None and not any(across):
        raise UsageError(
            "--within, --before and --after are about messages of other topics: add --where "
            "'TOPIC: PREDICATE'."
        )
    for predicate, is_across in zip(choices.where, across, strict=True):
        query = query.where(predicate, near if is_across else None)
    if choices.fields is not None:
        query = query.fields(*parse_fields(choices.fields))
    query = choices.placed(query)
    query = query.every(choices.every) if choices.every > 1 else query
    query = query.reverse() if choices.reverse else query
    return query if choices.limit is None else query.limit(choices.limit)
