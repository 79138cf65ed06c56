"""`hybridlog keep`: rules of retention, and pins; `index`; `verify`."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import nullcontext, suppress
from fnmatch import fnmatchcase
from functools import partial
from typing import TYPE_CHECKING, Any

import click
from msgspec.structs import asdict, replace

from hybridlog.cli import output
from hybridlog.cli.options import (
    SOME_SECONDS,
    AsJson,
    Choosing,
    InStore,
    Quiet,
    argument,
    command,
    names_argument,
    option,
    query_of,
    recordings_of,
)
from hybridlog.cli.output import Bar, Column
from hybridlog.cli.signals import watch
from hybridlog.query.times import parse_duration, parse_time
from hybridlog.query.topics import split_topic
from hybridlog.wording import listed
from hybridlog_storage.errors import StoreError, TopicError, UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hybridlog.index.of_store import FieldIndex
    from hybridlog.store import Store
    from hybridlog_storage.catalog import RecordingSummary
    from hybridlog_storage.manifest import Pin


_MAX_PINS = 1000
_RULES = ("quota", "min_free", "max_age", "never_tag", "fields_age", "save", "dry_run")


class _Keep(Choosing, InStore, AsJson, Quiet):
    quota: str | None = option("The most that the store may take, such as 200GB.", "SIZE")
    min_free: str | None = option("The least that stays free on the disk.", "SIZE")
    max_age: str | None = option("Payloads older than this go, such as 30d.", "DURATION")
    topic: tuple[str, ...] = option(
        "Payloads of this topic go at this age, and first when room is short; earlier ones "
        "before later ones. With --pin: TOPIC alone, to pin only this topic.",
        "TOPIC=AGE",
        short="-t",
    )
    never_tag: tuple[str, ...] = option(
        "Nothing of recordings with this tag goes; K alone is any value.", "K=V"
    )
    fields_age: str | None = option(
        "Recordings older than this go, with fields and counts, such as 2y.", "DURATION"
    )
    save: bool = option(
        "Write these rules into the store, for recorders too.",
        needs=("quota", "min_free", "max_age", "topic", "never_tag", "fields_age"),
    )
    dry_run: bool = option("Only say what would go.")
    pin: bool = option(
        "Pin recordings, or a time of them: it never goes.", excludes=("unpin", "pins", *_RULES)
    )
    at: str | None = option(
        "With --pin: the time around T, see --before and --after.", "T", needs=("pin",)
    )
    when: tuple[str, ...] = option(
        "With --pin: whenever this held, such as 'scan: ranges.min < 0.5', or around "
        "messages of a topic alone, or of marks.",
        "TOPIC: PREDICATE",
        needs=("pin",),
    )
    before: str = option(
        "With --at or --when: so much before it, too.", "TIME", default="0s", needs=("at", "when")
    )
    after: str = option(
        "With --at or --when: so much after it, too.", "TIME", default="0s", needs=("at", "when")
    )
    reason: str = option("With --pin: why.", "TEXT", default="", needs=("pin",))
    unpin: tuple[str, ...] = option("Remove a pin.", "PIN", excludes=("pins", "topic", *_RULES))
    pins: bool = option("List the pins.", excludes=("topic", *_RULES))


@command(_Keep)
def keep_command(given: _Keep) -> int:
    """Keep the store within a quota; pin what never goes.

    Payloads go, fields and counts stay. Without options for rules, those of [retention] in
    hybridlog.toml hold. Above 90 % of the quota payloads go until it is 80 %, those of the
    topics of --topic first, then the oldest. Exits with 1 when not enough may go.
    """
    rules, is_all = {} if given.pin else _rules(given), given.choice.is_everything
    if given.pin and is_all:
        raise UsageError("Choose the recordings to pin: -r 'monday*', --tag robot=7, -r '*'.")
    if not (given.pin or given.pins or given.unpin or is_all):
        raise UsageError("Rules are for the whole store; --never-tag leaves recordings out.")
    with given.opened() as store:
        if given.pin:
            found = _pin(store, given)
            output.tell(found, [f"{output.counted(len(found), 'pin')}: {listed(found)}"])
        elif given.unpin:
            store.unpin(*given.unpin)
        elif given.pins:
            rows = (
                {"recording": entry.name, **pin_dict(pin)}
                for entry in given.recordings_in(store)
                for pin in entry.manifest.pins
            )
            given.show(rows, _PINS)
        else:
            return _keep(store, rules, given)
    return 0


def _rules(given: _Keep) -> dict[str, Any]:
    """Options in the form of the table `[retention]`."""
    names = ("quota", "min_free", "max_age", "fields_age", "never_tag")
    named: dict[str, Any] = {name.replace("_", "-"): getattr(given, name) for name in names}
    named |= {"never-tag": [*given.never_tag], "topic": {}}
    for word in given.topic:
        pattern, _, age = word.rpartition("=")
        if not pattern or not age:
            raise UsageError(f"--topic takes TOPIC=AGE, such as '/camera/**=7d', not {word!r}.")
        named["topic"][pattern] = age
    return {key: value for key, value in named.items() if value}


def _pin(store: Store, given: _Keep) -> list[str]:
    """Pin what is asked for; returns the names of the pins."""
    topics = query_of(store, given.topic, given.choice).topics if given.topic else None
    spans = [*_spans(store, given)]
    if len(spans) > _MAX_PINS:
        raise UsageError(
            f"These are {len(spans)} times, and {_MAX_PINS} can be pinned at once: join them "
            "with --before and --after."
        )
    if not spans:
        why = "the predicate never held" if given.when else "no recording has messages then"
        raise UsageError(f"Nothing to pin: {why}.")
    reason = given.reason or "; ".join(given.when)
    return [store.pin(name, begin, end, topics, reason) for name, begin, end in spans]


def _spans(store: Store, given: _Keep) -> Iterator[tuple[str, int | None, int | None]]:
    """Id of a recording, begin and end of what is to be pinned of it; None for all."""
    from hybridlog.maintenance.edit import may_hold
    from hybridlog.query.answers.interval_queries import mark_topics

    before, after = given.before, given.after
    for entry in () if given.when else given.recordings_in(store):
        if given.at is None:
            yield entry.id, None, None
            continue
        start, end = entry.extent
        at = parse_time(given.at, start=start, end=end)
        span = at - parse_duration(before), at + parse_duration(after) + 1
        if may_hold(entry, *span):
            yield entry.id, *span
    for condition in given.when:
        pattern, predicate = split_topic(condition)
        query = query_of(store, [pattern], given.choice)
        if predicate:
            query = query.where(predicate)
        if predicate and not {*query.topics} <= {*mark_topics(store.session)}:
            found = query.intervals().widened(before, after)
        else:
            found = query.windows(before, after)
        # A moment is a range of one nanosecond.
        yield from ((one.recording, one.begin_ns, one.end_ns + 1) for one in found)


_PINS = [
    Column("pin", "id"),
    Column("recording"),
    Column("from", kind="time"),
    Column("to", kind="time"),
    Column("topics", lambda pin: "all" if pin["topics"] is None else listed(pin["topics"])),
    Column("reason"),
]


def pin_dict(pin: Pin) -> dict[str, Any]:
    """A pin for JSON; `to` is the time behind it."""
    end = None if pin.last is None else pin.last + 1
    about = {"topics": pin.topics, "reason": pin.reason}
    return {"id": pin.id, "from": pin.first, "to": end, **about}


def _keep(store: Store, rules: dict[str, Any], given: _Keep) -> int:
    from hybridlog.maintenance.retention import Rules

    wanted = rules or store.directory.settings.retention
    parsed = Rules.of(wanted)
    if parsed.is_empty:
        raise UsageError(
            "No rule says what may go: give --quota, --min-free, --max-age, --topic or "
            "--fields-age, or write them into [retention] of hybridlog.toml, as --save does."
        )
    if given.save:
        store.directory.check_writable()
        store.directory.change_settings(retention=rules)
    found = store.keep(wanted, dry_run=given.dry_run)
    plan, size = found.plan, output.size
    if not given.as_json:
        given.show(plan.steps, _STEPS)
    freed, what = found.freed_bytes, "freed"
    if given.dry_run:
        freed, what = sum(step.bytes for step in plan.steps), "would become free"
    room = f"{size(plan.used_bytes)} used, {size(plan.free_bytes)} free"
    output.tell({**asdict(found), "dry_run": given.dry_run}, [f"{room}: {size(freed)} {what}"])
    topics = store.topics()
    useless = (
        f"No topic matches {rule.pattern}, so its rule deletes nothing."
        for rule in parsed.topics
        if not any(map(rule.fits, topics))
    )
    output.notes((*found.problems, *plan.warnings, *useless))
    return 1 if found.problems or plan.is_short else 0


_STEPS = [
    Column("recording", lambda step: step.recording),
    Column("segments", lambda step: listed(map(str, step.segments)) if step.segments else "all"),
    Column("about", lambda step: step.bytes, "bytes"),
    Column("reason", lambda step: step.reason),
]


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


class _Verify(Choosing, InStore, AsJson, Quiet):
    names: tuple[str, ...] = names_argument()  # type: ignore[misc]
    repair: bool = option("Mend what can be mended without losing anything; list the rest.")
    new_id: bool = option(
        "With --repair: the store is a copy, give it an id of its own, with the index at --mongo.",
        needs=("repair",),
    )


@command(_Verify)
def verify_command(given: _Verify) -> int:
    """Read everything, and check checksums.

    Exits with 1 when it finds a problem, and prints a cure for each. With --repair, it restores
    the names of segments, makes damaged summaries and lost manifests again, and brings catalog and
    index up to date before that.
    """
    if given.new_id:
        from hybridlog.maintenance.verify import become_another
        from hybridlog.store import store_path

        become_another(store_path(given.store), given.mongo)
        output.note("The store has a new id now.")
    started = time.monotonic()
    with given.opened(verifies=True) as store:
        chosen, unreadable = _chosen(given, store)
        ids = None if given.choice.is_everything else [*unreadable, *(one.id for one in chosen)]
        with Bar("verify") as bar:
            result = store.verify(ids, bar.part, repair=given.repair)
    elapsed = time.monotonic() - started
    if given.as_json:
        output.print_json({**asdict(result), "seconds": round(elapsed, 3)})
    else:
        lines = [(one.recording, one.place, f"mended: {one.done}") for one in result.repaired]
        lines += (
            (one.recording, one.place, f"{one.problem.removesuffix('.')}; {one.cure}")
            for one in result.findings
        )
        for line in lines:
            output.say(": ".join(filter(None, line)))
        many = len(result.findings)
        told = (
            f"{output.counted(result.recordings, 'recording')}, "
            f"{output.counted(result.chunks, 'chunk')}, "
            f"{output.counted(result.messages, 'message')}, "
            f"{output.size(result.bytes_read)} read in {elapsed:.2f} s: "
            f"{output.counted(many, 'problem') if many else 'all is well'}"
        )
        output.tell(None, [told])
        if running := [one.name for one in chosen if one.status == "open"]:
            said = f"Still being recorded, and checked as far as sealed: {listed(running)}."
            output.remarks([said])
    return 1 if result.findings else 0


def _chosen(given: _Verify, store: Store) -> tuple[Sequence[RecordingSummary], list[str]]:
    """The chosen recordings, and ids of chosen ones that cannot be read: their names are lost."""
    choice, known = given.choice, store.shared.repairs.unreadable
    unreadable = [one for one in known if any(fnmatchcase(one, name) for name in choice.name)]
    names = tuple(name for name in choice.name if name not in unreadable)
    if names or not unreadable:
        with suppress(TopicError) if unreadable else nullcontext():
            return recordings_of(store, replace(choice, name=names)).summaries, unreadable
    return (), unreadable
