"""`hybridlog fetch`."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import click

from hybridlog.cli import output
from hybridlog.cli.answers import (
    SCREEN,
    Destination,
    Tabular,
    answer_query,
    format_option,
    latched,
    output_option,
    print_cost,
    print_lost,
    print_remarks,
    write_following,
)
from hybridlog.cli.binder import command, option
from hybridlog.cli.completion import complete_path
from hybridlog.cli.options import Asking, Slices, in_frame, parse_fields, query_of
from hybridlog.cli.signals import Stopped
from hybridlog.formats import OUTPUTS, formats_of, is_directory
from hybridlog.formats.slices import Front
from hybridlog_storage.errors import TopicError, UsageError
from hybridlog_storage.stopping import at_safe_points

if TYPE_CHECKING:
    from hybridlog.query.counters import Counters
    from hybridlog.query.query import Query
    from hybridlog.store import Store

_FORMATS = formats_of()


@dataclass(frozen=True, kw_only=True)
class _Choices(Asking, Tabular, Slices):
    needs_topic: ClassVar[bool] = True
    formats: ClassVar[Sequence[str]] = _FORMATS

    @property
    def usual(self) -> tuple[str, str]:  # type: ignore[override]
        """The format on a terminal, and elsewhere."""
        return "jsonl" if self.follow else SCREEN, "jsonl"

    clock: str = option(
        "The clock of --between.", type=click.Choice(["log", "publish", "header"]), default="log"
    )
    at: str | None = option("Only the message that was current at this time.", "T")
    every: int = option("Only every n-th message.", "N", type=click.IntRange(min=1), default=1)
    reverse: bool = option("Latest first.")
    follow: bool = option(
        "Of running recordings: print messages as they come, from now on or from the "
        "beginning of --between, until the recordings end or Ctrl-C."
    )
    fields: str | None = option(
        "Only these fields, with commas between them.", "A,B.C", shell_complete=complete_path
    )
    frame: str | None = in_frame()
    within: str | None = option(
        "Greatest distance in time of messages of other topics in --where "
        "'/odom: twist.twist.linear.x > 0.5'.",
        "DURATION",
    )
    before: str | None = option(
        "With such a --where, in place of --within: from this long before each match on, "
        "such as 5min.",
        "DURATION",
    )
    after: str | None = option(
        "With such a --where, in place of --within: until this long after each match.", "DURATION"
    )
    count: bool = option("Only print how many.")
    form: str | None = format_option(_FORMATS)
    output: Path | None = output_option(
        "Write to this file (raw: a directory; png and jpg: a directory, or one picture)"
    )


@command(_Choices)
def fetch_command(choices: _Choices) -> None:
    """Fetch messages by topic, time and content.

    Without --format and -o: a table on a terminal, JSON lines elsewhere. The cost of the
    answer, and what it may lack, is printed on standard error.
    """
    to = _destination(choices)
    started = time.monotonic()
    with choices.opened(is_lasting=choices.follow, snapshot=not choices.follow) as store:
        query = _query(store, choices)
        if choices.follow:
            _follow(query, choices, to.form)
            return
        if choices.at is not None:
            try:
                query = query.at_time(choices.at)
            except TopicError:
                if not choices.quiet:
                    print_remarks(query.between("start", choices.at), is_empty=False)
                raise
        count = None
        if choices.strict:
            query.completeness().check(payloads=not choices.count)
        if choices.count:
            count = query.count()
            if choices.strict:
                query.completeness().check()
            output.say(str(count))
        else:
            front = Front(
                # With --at, the answer is one message; a video needs those before it.
                latched=not choices.no_latched and (choices.at is None or to.form == "mp4"),
                original_times=choices.original_times,
            )
            if choices.split is not None:
                _write_pieces(query, choices, to, front)
                return
            query = answer_query(query, to, front=front, strict=choices.strict)
        sys.stdout.flush()
        if not choices.quiet:
            cost = _cost_of(query)
            print_cost(cost, time.monotonic() - started, count=choices.count)
            given = cost.messages or cost.latched or cost.frames
            if count is None and to.path is not None and not given:
                what = " and ".join(f"'{one}'" for one in choices.where) or "the question"
                output.note(f"Nothing matched {what}, so {to.path} is empty.")
            print_remarks(query)
            if count is not None:
                print_lost(query, count)


def _write_pieces(query: Query, choices: _Choices, to: Destination, front: Front) -> None:
    """Write a file for each part of the answer, and a line about each."""
    from hybridlog.cli.export import pieces

    how = choices.split
    assert to.path is not None
    assert how is not None
    folder = is_directory(to.form, to.path)
    for path, one in pieces(query, how, to.path, force=to.force, is_directory=folder):
        answer_query(one, replace(to, path=path), front=front, strict=choices.strict)
        if not to.quiet:
            counters = one.counters
            given = output.counted(counters.messages - counters.reduced, "message")
            output.note(f"{path}: {given}{latched(counters)}")
            output.notes(one.completeness().sentences)


def _follow(query: Query, choices: _Choices, form: str) -> None:
    """Print messages as they come, then what they may lack."""
    started = time.monotonic()
    following = query.follow(*choices.topics)
    stopped: Stopped | None = None
    try:
        with at_safe_points():
            write_following(following, form)
    except Stopped as error:
        stopped = error
    if not choices.quiet:
        print_cost(query.counters, time.monotonic() - started, count=False)
        from hybridlog.cli.ls import status_text
        from hybridlog.query.query import Query

        asked = Query(query.session, following.question)
        asked.counters = query.counters
        print_remarks(asked)
        for one in asked.summaries():
            if one.status != "open":
                output.note(f"{one.name} has ended: {status_text(one)}.")
    if stopped is not None:
        raise stopped


def _query(store: Store, choices: _Choices) -> Query:
    query = choices.bounded(query_of(store, choices.topics, choices.choice))
    query = query.clock(choices.clock)
    near = _near(choices)
    for predicate in choices.where:
        query = query.where(predicate, near if _names_topics(predicate) else None)
    if choices.fields is not None:
        query = query.fields(*parse_fields(choices.fields))
    if choices.frame is not None:
        query = query.in_frame(choices.frame)
    if choices.tags is not None:
        query = query.tags(*parse_fields(choices.tags, "--tags"))
    if choices.every > 1:
        query = query.every(choices.every)
    if choices.reverse:
        query = query.reverse()
    if choices.limit is not None:
        query = query.limit(choices.limit)
    return query


def _destination(choices: _Choices) -> Destination:
    """Format and place of the answer; refuses what makes no sense before a store is opened."""
    assert choices.topics
    _check_near(choices)
    _check_together(choices)
    to = choices.destination()
    form = to.form
    to = replace(to, settings=choices.settings(form))
    as_it_came = form in OUTPUTS and OUTPUTS[form].content in {"log", "pictures", "video"}
    if choices.frame is not None and (as_it_came or form == "raw"):
        raise UsageError(f"{form} has messages as they came: --in-frame is for tables and ply.")
    if choices.split is not None and to.path is None:
        raise UsageError("--split-by writes files: name them with -o.")
    if not choices.count and choices.split is None:
        to.check()
    return to


def _check_together(choices: _Choices) -> None:
    """Refuse options that make no sense together."""
    with_others = any(map(_names_topics, choices.where)), "--where with other topics"
    alone: dict[str, list[tuple[bool, str]]] = {}
    if choices.split is not None:
        alone["--split-by writes files"] = [
            (choices.count, "--count"),
            (choices.at is not None, "--at"),
            (choices.follow, "--follow"),
            (choices.reverse, "--reverse"),
            (choices.form == "table", "--format table"),
        ]
    if choices.count:
        alone["--count prints a number"] = [
            (choices.output is not None, "--output"),
            (choices.form is not None, "--format"),
        ]
    if choices.at is not None:
        alone["--at gives one message, by log time"] = [
            (choices.between is not None, "--between"),
            (choices.last is not None, "--last"),
            (choices.limit is not None, "--limit"),
            (choices.every > 1, "--every"),
            (choices.reverse, "--reverse"),
            (choices.clock != "log", "--clock"),
            with_others,
        ]
    if choices.follow:
        alone["--follow prints messages as they come, in lines (jsonl, csv)"] = [
            (choices.as_json, "--json"),
            (not _is_lines(choices.form), f"--format {choices.form}"),
            (choices.output is not None, "--output"),
            (choices.reverse, "--reverse"),
            (choices.count, "--count"),
            (choices.at is not None, "--at"),
            (choices.strict, "--strict"),
            (choices.frame is not None, "--in-frame"),
            with_others,
        ]
    for reason, others in alone.items():
        for given, name in others:
            if given:
                raise UsageError(f"{reason}: leave out {name}.")


def _is_lines(form: str | None) -> bool:
    """True for text without an end, which a list in JSON has."""
    return form is None or (form in OUTPUTS and OUTPUTS[form].is_text and form != "json")


def _near(choices: _Choices) -> str | tuple[str, str] | None:
    """Greatest distance in time to the messages of other topics in --where."""
    around = choices.before, choices.after
    if around == (None, None):
        return choices.within
    return around[0] or "0s", around[1] or "0s"


def _names_topics(predicate: str) -> bool:
    from hybridlog.query.predicate.across import names_topics

    return names_topics(predicate)


def _check_near(choices: _Choices) -> None:
    around = choices.before is not None or choices.after is not None
    if around and choices.within is not None:
        raise UsageError("--within is before and after: leave out --before and --after.")
    near = around or choices.within is not None
    asks = any(map(_names_topics, choices.where))
    if near and not asks:
        raise UsageError(
            "--within, --before and --after are about messages of other topics: add --where "
            "'TOPIC: PREDICATE'."
        )
    if asks and not near:
        raise UsageError(
            "--where with another topic needs a length of time: add --within, --before or --after."
        )


def _cost_of(query: Query) -> Counters:
    """The cost of an answer, with that of its conditions on other topics."""
    cost = query.counters.copy()
    for condition in query.conditions:
        cost.add(condition.counters)
    return cost
