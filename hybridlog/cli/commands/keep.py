"""`hybridlog keep`: rules of retention, and pins."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from msgspec.structs import asdict

from hybridlog.cli import output
from hybridlog.cli.options import (
    AsJson,
    Choosing,
    InStore,
    Quiet,
    command,
    option,
    query_of,
)
from hybridlog.cli.output import Column
from hybridlog.query.times import parse_duration, parse_time
from hybridlog.query.topics import split_topic
from hybridlog.wording import listed
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from hybridlog.store import Store
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
