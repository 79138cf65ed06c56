"""`hybridlog index` and `trust`: what the index has, and whose MongoDB is used."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hybridlog.cli import options, output
from hybridlog.cli.completion import complete_topic
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.progress import Stages, progress_bar
from hybridlog.cli.query_options import recordings_of
from hybridlog.cli.signals import Stopped, if_stopped
from hybridlog_storage.errors import DatabaseError, StoreError, UsageError
from hybridlog_storage.stopping import at_safe_points, pause

if TYPE_CHECKING:
    from collections.abc import Callable

    from hybridlog.index.field_indexes import FieldIndex
    from hybridlog.query.choice import Choice
    from hybridlog.store import Store


_FIELDS = click.argument(
    "field",
    nargs=-1,
    required=True,
    metavar="FIELD...",
    help="Its fields, the most selective first.",
)
_TOPIC = click.argument("topic", metavar="TOPIC", shell_complete=complete_topic, help="A topic.")


def _options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that commands of the group share."""
    for option in (options.quiet, options.as_json, options.mongo, options.store):
        command = option(command)
    return command


@click.group()
def index_command() -> None:
    """Index fields in MongoDB, for questions and other programs."""


@index_command.command("list")
@click.argument(
    "topic",
    required=False,
    metavar="[TOPIC]",
    shell_complete=complete_topic,
    help="A topic; without, all.",
)
@_options
def list_(
    *, topic: str | None, store: Path | None, mongo: str | None, as_json: bool, quiet: bool
) -> None:
    """List the indexes on fields."""
    with opened_store(store, mongo, needs_database=True, quiet=quiet) as opened:
        found = opened.indexes() if topic is None else opened.indexes(topic)
    _print(found, as_json=as_json, quiet=quiet)


@index_command.command()
@_TOPIC
@_FIELDS
@_options
def add(
    *,
    topic: str,
    field: tuple[str, ...],
    store: Path | None,
    mongo: str | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Make an index on fields of a topic, for all recordings."""
    with opened_store(store, mongo, needs_database=True, quiet=quiet) as opened:
        found = opened.add_index(topic, *field)
    _print(found, as_json=as_json, quiet=quiet)


@index_command.command()
@_TOPIC
@_FIELDS
@_options
def remove(
    *,
    topic: str,
    field: tuple[str, ...],
    store: Path | None,
    mongo: str | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Drop an index."""
    with opened_store(store, mongo, needs_database=True, quiet=quiet) as opened:
        if not opened.remove_index(topic, *field):
            known = ", ".join(" ".join(one.fields) for one in opened.indexes(topic)) or "none"
            raise UsageError(f"{topic} has no index on {' '.join(field)}. Its indexes: {known}.")
        found = opened.indexes(topic)
    _print(found, as_json=as_json, quiet=quiet)


@index_command.command()
@_options
def address(*, store: Path | None, mongo: str | None, as_json: bool, quiet: bool) -> None:
    """Print the address of the index for other programs, and what is in it.

    The index is brought up to date first. The embedded MongoDB keeps its address, waits ten
    minutes for the first client, and runs as long as one is connected.
    """
    with opened_store(store, mongo, needs_database=True, quiet=quiet) as opened:
        found = opened.index_address()
        places = [] if quiet and not as_json else opened.index_contents()
        recordings = len(opened.session.snapshot())
    if as_json:
        topics = [
            {"topic": topic, "collection": collection, "documents": documents}
            for topic, collection, documents in places
        ]
        about = {"uri": found.uri, "database": found.database, "recordings": recordings}
        output.print_json({**about, "topics": topics})
        return
    output.say(found.uri)
    if not quiet:
        output.print_table(
            (("topic", "whole"), ("collection", "whole"), ("documents", "right")),
            [(topic, collection, str(documents)) for topic, collection, documents in places],
        )
        output.say(f"database {found.database}, {output.counted(recordings, 'recording')}")


@index_command.command()
@options.choice
@options.store
@options.mongo
@options.cache_size
@options.as_json
@options.quiet
def rebuild(
    *,
    choice: Choice,
    store: Path | None,
    mongo: str | None,
    cache_size: int | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Rebuild the index from the segments, recording by recording.

    Queries of the other recordings work meanwhile. After an interruption, the next command
    that needs the index finishes the recording at which it stopped.
    """
    started = time.monotonic()
    with opened_store(
        store, mongo, needs_database=True, cache_mb=cache_size, quiet=quiet
    ) as opened:
        chosen = recordings_of(opened, choice)
        total = sum(entry.stored_bytes for entry in chosen.summaries)
        with (
            if_stopped(
                "Finished recordings stay indexed; the next command that needs the index "
                "finishes the recording at which it stopped."
            ),
            progress_bar("index rebuild", total, quiet=quiet) as bar,
        ):
            done = opened.rebuild_index(None if choice.is_everything else chosen, Stages(bar))
    left = [entry.label for entry in chosen.summaries if entry.id not in {r.id for r in done}]
    for label in left:
        output.note(f"Recording {label} is in use, and was left as it is.")
    for entry in done:
        if entry.status == "damaged":
            output.note(f"{entry.label} is damaged: `hybridlog losses {entry.label}` shows where.")
    messages = sum(r.documents for r in done)
    without = sum(r.messages for r in done) - messages
    elapsed = time.monotonic() - started
    if as_json:
        output.print_json(
            {
                "recordings": len(done),
                "messages": messages,
                "messages_without_documents": without,
                "left": left,
                "seconds": round(elapsed, 3),
            }
        )
    elif not quiet:
        output.say(
            f"{output.counted(len(done), 'recording')}, "
            f"{output.counted(messages, 'message')} indexed in {elapsed:.2f} s"
            f"{output.without_documents(without)}"
        )


@index_command.command()
@click.option(
    "--every",
    default="2s",
    show_default=True,
    metavar="DURATION",
    help="Time between two looks at the store.",
)
@_options
def watch(*, every: str, store: Path | None, mongo: str | None, as_json: bool, quiet: bool) -> None:
    """Index recordings as they come into the store, until Ctrl-C.

    For a server into whose store robots copy. While MongoDB is unavailable, it tries again.
    Several may watch one store.
    """
    from hybridlog.query.times import parse_duration

    pause_s = parse_duration(every) / 1e9
    if pause_s <= 0:
        raise UsageError(f"--every {every} is no time to wait. Give a duration such as 2s.")
    with (
        opened_store(store, mongo, needs_database=True, quiet=quiet, is_lasting=True) as opened,
        at_safe_points(),
    ):
        try:
            if not quiet:
                output.note(f"Watching {opened.directory.path}. Ctrl-C ends it.")
            told: set[str] = set()
            while True:
                _look(opened, told, as_json=as_json, quiet=quiet)
                pause(pause_s)
        except Stopped:
            return


def _look(store: Store, told: set[str], *, as_json: bool, quiet: bool) -> None:
    """Index what has come since the last look, and report it.

    Args:
        store: The store.
        told: Problems that were reported and are not over; changed.
        as_json: A line of JSON a recording.
        quiet: Problems only.
    """
    if store.session.snapshot().is_open.any() or store.session.has_changed():
        store.refresh()
    problems = set()
    try:
        store.connect()
    except (DatabaseError, StoreError) as error:
        problems.add(str(error))
    repairs = store.repairs
    for label, problem in [*repairs.unreadable.items()]:
        problems.add(f"Recording {label} cannot be read: {problem}")
    for label in [*repairs.indexed]:
        chunks = repairs.indexed.pop(label)
        if not chunks:  # another process was faster
            continue
        if as_json:
            output.print_json_line({"recording": label, "chunks": chunks})
        elif not quiet:
            output.say(f"{label}  {output.counted(chunks, 'chunk')}")
            sys.stdout.flush()
    for problem in sorted(problems - told):
        output.note(problem)
    told.clear()
    told.update(problems)


def _print(found: list[FieldIndex], *, as_json: bool, quiet: bool) -> None:
    if as_json:
        output.print_json([{"topic": one.topic, "fields": list(one.fields)} for one in found])
    elif found:
        output.print_table(
            (("topic", "whole"), ("fields", "left")),
            [(one.topic, " ".join(one.fields)) for one in found],
        )
    elif not quiet:
        output.say("no index on a field")


@click.command()
@options.store
@click.option("--forget", is_flag=True, help="Do not trust this store's server any more.")
def trust_command(*, store: Path | None, forget: bool) -> None:
    """Trust the MongoDB server that another user's store names.

    Until then, commands do not connect to it: a user's own stores only are trusted. The store
    does not contain the password: see HYBRIDLOG_MONGO_PASSWORD.
    """
    from hybridlog.index import consent
    from hybridlog.store import store_path
    from hybridlog_storage.settings import is_uri, read_settings

    settings = read_settings(store_path(store))
    if forget:
        found = consent.forget(settings.store_id)
        output.say("forgotten" if found else "nothing was trusted")
    elif not is_uri(settings.mongo):
        output.say("the store names no MongoDB: there is nothing to trust")
    else:
        consent.remember(settings.store_id, settings.mongo)
        output.say(f"trusted {settings.mongo}")
