"""`hybridlog index`: what the index has, and where it is."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING

import click
from msgspec.structs import asdict

from hybridlog.cli import output
from hybridlog.cli.options import (
    SOME_SECONDS,
    AsJson,
    Choosing,
    InStore,
    Quiet,
    argument,
    command,
    option,
)
from hybridlog.cli.output import Bar, Column
from hybridlog.cli.signals import watch
from hybridlog.wording import listed
from hybridlog_storage.errors import StoreError, UsageError

if TYPE_CHECKING:
    from hybridlog.index.of_store import FieldIndex
    from hybridlog.store import Store


@click.group()
def index_command() -> None:
    """Index fields in MongoDB, or arrays in tables."""


class _Shared(InStore, AsJson, Quiet):
    pass


class _Listed(_Shared):
    topic: str | None = argument("A topic; without, all.", "[TOPIC]")


@command(_Listed, "list", to=index_command)
def list_(given: _Listed) -> None:
    """List the indexes on fields."""
    with given.opened(require_database=True) as store:
        found = store.index.list() if given.topic is None else store.index.list(given.topic)
    _show(found, given, "No index on a field.")


class _Fields(_Shared):
    topic: str = argument("A topic.", "TOPIC")
    field: tuple[str, ...] = argument(
        "Its fields, the most selective first.", "FIELD...", required=True
    )


@command(_Fields, to=index_command)
def add(given: _Fields) -> None:
    """Make an index on fields of a topic, for all recordings."""
    with given.opened(require_database=True) as store:
        found = store.index.add(given.topic, *given.field)
    _show(found, given)


@command(_Fields, to=index_command)
def remove(given: _Fields) -> None:
    """Drop an index, and list those that are left."""
    topic, field = given.topic, " ".join(given.field)
    with given.opened(require_database=True) as store:
        was_there = store.index.remove(topic, *given.field)
        found = store.index.list(topic)
    if not was_there:
        known = listed(" ".join(one.fields) for one in found)
        raise UsageError(f"{topic} has no index on {field}. Its indexes: {known}.")
    _show(found, given)


def _show(found: list[FieldIndex], given: _Shared, without: str = "") -> None:
    given.show([one._asdict() for one in found], _FIELDS, without)


_FIELDS = [Column("topic"), Column("fields", lambda row: " ".join(row["fields"]))]


@command(_Shared, to=index_command)
def address(given: _Shared) -> None:
    """Print where other programs find the index.

    The index is brought up to date first. The embedded MongoDB keeps its address, waits ten
    minutes for the first client, and runs as long as one is connected.
    """
    with given.opened(require_database=True) as store:
        found = store.index.address()
    if given.as_json:
        output.print_json({"uri": found.uri, "database": found.database})
        return
    output.say(found.uri)
    output.tell(None, [f"database {found.database}"])


class _Rebuild(Choosing, _Shared):
    """Which recordings are indexed again."""


@command(_Rebuild, to=index_command)
def rebuild(given: _Rebuild) -> None:
    """Rebuild the index from the segments, recording by recording.

    Without -r it is emptied first. After an interruption, the next command that needs the
    index makes the rest.
    """
    with given.opened(require_database=True) as store:
        chosen = given.recordings_in(store)
        with Bar("index rebuild") as bar:
            done = store.index.rebuild(None if given.choice.is_everything else chosen, bar.part)
    names = ("messages", "documents")
    rows = [{"recording": one.name} | {name: getattr(one, name) for name in names} for one in done]
    given.show(rows, _REBUILT)
    if left := [one.name for one in chosen.summaries if one.id not in {e.id for e in done}]:
        output.note(f"In use, and left as they are: {listed(left)}.")


_REBUILT = [
    Column("recording"),
    Column("messages", kind="number"),
    Column("documents", kind="number"),
]


class _Arrays(_Shared):
    topic: tuple[str, ...] = argument("Topics.", "TOPIC...", required=True)
    off: bool = option("Make their tables without arrays again.")


@command(_Arrays, to=index_command)
def arrays(given: _Arrays) -> None:
    """Keep long arrays in the tables of topics.

    Tables have a summary of an array with more than 32 elements. Of these topics they get the
    array in its place: predicates on elements of arrays and SQL then read columns. Tables of
    point clouds get a list for each field of the points, for SQL, DuckDB and other readers of
    the files. New recordings follow, and tables of ended ones are made anew at once. Segments
    stay as they are, so this costs room. MongoDB is not needed.
    """
    with given.opened() as store, Bar("index arrays") as bar:
        found = store.index.arrays(*given.topic, off=given.off, progress=bar.part)
    given.show(map(asdict, found), _ARRAYS)
    if left := {name for one in found for name in one.left}:
        output.note(
            f"Tables of {listed(sorted(left))} stay as they are: the recording is in progress or "
            "cannot be read, or the disk has no room. Run it again later."
        )


_ARRAYS = [
    Column("topic"),
    Column("made anew", lambda row: len(row["recordings"]), "number"),
    Column("tables", "bytes", "bytes"),
]


class _Watch(_Shared):
    every: float = option(
        "Time between two looks at the store.", "DURATION", type=SOME_SECONDS, default="2s"
    )


@command(_Watch, "watch", to=index_command)
def watch_command(given: _Watch) -> None:
    """Index recordings as they come into the store, until Ctrl-C.

    For a server into whose store robots copy. While MongoDB is unavailable, it tries again.
    Several may watch one store.
    """
    with given.opened(require_database=True) as store:
        look = partial(_index_new, store)
        watch(store.directory.path, look, pause_s=given.every)


def _index_new(store: Store) -> Iterator[StoreError]:
    """Index what has come since the last look, and print it; yields what cannot be read."""
    store.shared.newest()
    store.shared.recover()
    repairs = store.shared.repairs
    try:
        store.shared.index.connect()
    finally:
        for name in [*repairs.indexed]:
            chunks = repairs.indexed.pop(name)
            if not chunks:  # another process was faster
                continue
            line = f"{name}  {output.counted(chunks, 'chunk')}"
            output.tell({"recording": name, "chunks": chunks}, [line], at_once=True)
    for recording, problem in sorted(repairs.unreadable.items()):
        yield StoreError(f"Recording {recording} cannot be read: {problem}")
