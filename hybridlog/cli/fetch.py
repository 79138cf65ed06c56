"""`hybridlog fetch`."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hybridlog.cli import options, output
from hybridlog.cli.answer_notes import print_cost, print_lost, print_remarks
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.output_path import check_room, not_written, replacing
from hybridlog.cli.query_options import parse_fields, query_of
from hybridlog.cli.signals import Stopped, if_stopped
from hybridlog.cli.write_answer import write_answer, write_following
from hybridlog.export import PICTURES
from hybridlog.export.slices import Front
from hybridlog_storage.errors import TopicError, UsageError
from hybridlog_storage.stopping import at_safe_points

if TYPE_CHECKING:
    from hybridlog.query.choice import Choice
    from hybridlog.query.query import Query
    from hybridlog.store import Store

_FORMATS = ("table", "jsonl", "csv", "parquet", "arrow", "npz", "mcap", "bag", "raw", "png", "jpg")
_SUFFIXES = {
    ".jsonl": "jsonl",
    ".ndjson": "jsonl",
    ".csv": "csv",
    ".parquet": "parquet",
    ".arrow": "arrow",
    ".feather": "arrow",
    ".npz": "npz",
    ".mcap": "mcap",
    ".bag": "bag",
    ".png": "png",
    ".jpg": "jpg",
    ".jpeg": "jpg",
}
_TEXT = {"jsonl", "csv"}
_WITHOUT_COLUMNS = {"mcap", "bag", "raw", *PICTURES}


@dataclass(frozen=True, slots=True)
class _Choices:
    """The parameters of the command."""

    topic: tuple[str, ...]
    store: Path | None
    between: tuple[str, str] | None
    clock: str
    at: str | None
    where: tuple[str, ...]
    choice: Choice
    limit: int | None
    every: int
    reverse: bool
    follow: bool
    fields: str | None
    tags: str | None
    within: str | None
    before: str | None
    after: str | None
    strict: bool
    count: bool
    form: str | None
    output: Path | None
    no_latched: bool
    original_times: bool
    force: bool
    mongo: str | None
    quiet: bool


@click.command()
@options.topics
@options.store
@options.between
@click.option(
    "--clock",
    type=click.Choice(["log", "publish", "header"]),
    default="log",
    help="The clock of --between.",
)
@click.option("--at", metavar="T", help="Only the message that was current at this time.")
@options.where
@options.choice
@click.option(
    "--limit",
    "-n",
    type=click.IntRange(min=0),
    metavar="N",
    help="At most this number of messages.",
)
@click.option(
    "--every", type=click.IntRange(min=1), default=1, metavar="N", help="Only every n-th message."
)
@click.option("--reverse", is_flag=True, help="Latest first.")
@click.option(
    "--follow",
    is_flag=True,
    help="Of running recordings: print messages as they come, from now on or from the beginning "
    "of --between, until the recordings end or Ctrl-C.",
)
@click.option("--fields", metavar="A,B.C", help="Only these fields, with commas between them.")
@options.tag_columns
@click.option(
    "--within",
    metavar="DURATION",
    help="Greatest distance in time of messages of other topics in --where "
    "'/odom: twist.twist.linear.x > 0.5'.",
)
@click.option(
    "--before", metavar="DURATION", help="Instead: start this long before each of these: 5min."
)
@click.option("--after", metavar="DURATION", help="Instead: end this long after each of these.")
@options.strict
@options.count
@click.option(
    "--format",
    "-F",
    "form",
    type=click.Choice(_FORMATS),
    help="Without: by the suffix of -o, else a table on a terminal, else jsonl.",
)
@click.option(
    "--output",
    "-o",
    type=options.PATH,
    metavar="FILE",
    help="Write to this file (raw: a directory; png and jpg: a directory, or one picture); - is "
    "standard output.",
)
@options.no_latched
@options.original_times
@options.force
@options.mongo
@options.quiet
@options.verbose
def command(**parameters: Any) -> None:
    """Fetch messages by topic, time and content.

    Without --format and -o: a table on a terminal, JSON lines elsewhere. The cost of the
    answer, and what it may lack, is printed on standard error.
    """
    choices = _Choices(**parameters)
    form = _form(choices)
    path = _path(choices, form)
    started = time.monotonic()
    with opened_store(
        choices.store, choices.mongo, quiet=choices.quiet, is_lasting=choices.follow
    ) as store:
        query = _query(store, choices)
        if choices.follow:
            _follow(query, choices, form)
            return
        if choices.at is not None:
            try:
                query = query.at_time(choices.at)
            except TopicError:
                if not choices.quiet:
                    print_remarks(query.between("start", choices.at), (), is_empty=False)
                raise
        count = None
        if choices.strict:
            query.check_complete(payloads=not choices.count)
        if choices.count:
            count = query.count()
            output.say(str(count))
        else:
            query = _answer(query, form, path, choices)
        sys.stdout.flush()
        if not choices.quiet:
            cost = query.counters.copy()
            cost.add(query.spent)
            print_cost(cost, time.monotonic() - started, count=choices.count)
            print_remarks(query, choices.topic)
            if count is not None:
                print_lost(query, count)


def _follow(query: Query, choices: _Choices, form: str) -> None:
    """Print messages as they come, then what they may lack."""
    started = time.monotonic()
    following = query.follow(*choices.topic)
    stopped: Stopped | None = None
    try:
        with at_safe_points():
            write_following(following, form, sys.stdout.buffer)
    except Stopped as error:
        stopped = error
    if not choices.quiet:
        print_cost(query.counters, time.monotonic() - started, count=False)
        from hybridlog.cli.recording_summary import status
        from hybridlog.query.query import Query

        asked = Query(query.session, following.question)
        asked.counters = query.counters
        print_remarks(asked, choices.topic)
        for one in asked.summaries():
            if one.status != "open":
                output.note(f"{one.label} has ended: {status(one)}.")
    if stopped is not None:
        raise stopped


def _answer(query: Query, form: str, path: Path | None, choices: _Choices) -> Query:
    """Print or write the messages; returns the query with its counters."""
    if form == "table":
        from hybridlog.cli.screen import print_answer

        return print_answer(query)
    # With --at, the answer is one message.
    front = Front(
        latched=not choices.no_latched and choices.at is None,
        original_times=choices.original_times,
    )
    if path is None:
        write_answer(query, form, sys.stdout.buffer, front=front, quiet=True)
    else:
        with (
            if_stopped(partial(not_written, path)),
            replacing(path, force=choices.force, is_directory=_is_directory(path, form)),
        ):
            write_answer(query, form, path, front=front, quiet=choices.quiet)
    return query


def _query(store: Store, choices: _Choices) -> Query:
    query = query_of(store, choices.topic, choices.choice)
    if choices.between is not None:
        query = query.between(*choices.between)
    query = query.clock(choices.clock)
    near = _near(choices)
    for predicate in choices.where:
        query = query.where(predicate, near if _names_topics(predicate) else None)
    if choices.fields is not None:
        query = query.fields(*parse_fields(choices.fields))
    if choices.tags is not None:
        query = query.tags(*parse_fields(choices.tags, "--tags"))
    if choices.every > 1:
        query = query.every(choices.every)
    if choices.reverse:
        query = query.reverse()
    if choices.limit is not None:
        query = query.limit(choices.limit)
    return query


def _form(choices: _Choices) -> str:
    _check_near(choices)
    _check_together(choices)
    if choices.form is not None or choices.follow:
        form = choices.form or "jsonl"
    elif choices.output is None or str(choices.output) == "-":
        form = "table" if sys.stdout.isatty() else "jsonl"
    else:
        form = _form_of(choices.output)
    options.check_latched(
        no_latched=choices.no_latched, original_times=choices.original_times, form=form
    )
    if choices.tags is not None and form in _WITHOUT_COLUMNS:
        raise UsageError(f"--tags adds columns to tables, and {form} has none: leave it out.")
    if form == "table" and choices.output is not None:
        raise UsageError("A table is for the screen: use --format csv or parquet with -o.")
    return form


def _check_together(choices: _Choices) -> None:
    """Refuse options that --at or --follow make no sense with."""
    with_others = any(map(_names_topics, choices.where)), "--where with other topics"
    alone: dict[str, list[tuple[bool, str]]] = {}
    if choices.at is not None:
        alone["--at gives one message, by log time"] = [
            (choices.between is not None, "--between"),
            (choices.limit is not None, "--limit"),
            (choices.every > 1, "--every"),
            (choices.reverse, "--reverse"),
            (choices.clock != "log", "--clock"),
            with_others,
        ]
    if choices.follow:
        alone["--follow prints messages as they come, in lines (jsonl, csv)"] = [
            (choices.form not in {None, *_TEXT}, f"--format {choices.form}"),
            (choices.output is not None, "--output"),
            (choices.reverse, "--reverse"),
            (choices.count, "--count"),
            (choices.at is not None, "--at"),
            (choices.strict, "--strict"),
            with_others,
        ]
    for reason, others in alone.items():
        for given, option in others:
            if given:
                raise UsageError(f"{reason}: leave out {option}.")


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


def _form_of(path: Path) -> str:
    """The format that a suffix names.

    Raises:
        UsageError: It names none.
    """
    form = _SUFFIXES.get(path.suffix.lower())
    if form is None:
        raise UsageError(
            f"The name {path} does not give the format: add --format, or end it in "
            f"{', '.join(_SUFFIXES)}."
        )
    return form


def _path(choices: _Choices, form: str) -> Path | None:
    """The file to write; None for standard output. Errors come before the store is opened."""
    if choices.count:
        return None
    if choices.output is None or str(choices.output) == "-":
        if form not in {*_TEXT, "table"} and sys.stdout.isatty():
            what = "a directory" if form in PICTURES else "a file"
            raise UsageError(f"{form} is no text for a terminal: name {what} with -o.")
        return None
    is_directory = _is_directory(choices.output, form)
    check_room(choices.output, force=choices.force, is_directory=is_directory)
    return choices.output


def _is_directory(path: Path, form: str) -> bool:
    """True if the output is a directory with a file a message."""
    if form not in PICTURES:
        return form == "raw"
    from hybridlog.export.pictures import suffix_of

    return suffix_of(path) is None
