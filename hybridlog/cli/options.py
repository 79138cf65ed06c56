"""Options that several commands share, as base classes of their options."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import click

from hybridlog.cli import output
from hybridlog.cli.binder import Options, argument, option
from hybridlog.cli.output import Column, print_table
from hybridlog.query.choice import Choice
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from hybridlog.query.query import Query
    from hybridlog.query.times import TimeLike
    from hybridlog.recordings import Recordings
    from hybridlog.store import Store


class Place(Options):
    """The option of all commands on a store."""

    store: Path | None = option(
        "Directory of the store.", "DIR", envvar="HYBRIDLOG_STORE", show_envvar=True
    )


class InStore(Place):
    """Options of commands that may ask MongoDB."""

    mongo: str | None = option(
        "URI of the MongoDB that holds the index, 'embedded' for our own, or 'none'; "
        "without, the one that the store was made with.",
        "URI",
        envvar="HYBRIDLOG_MONGO_URI",
        show_envvar=True,
    )

    def opened(self, **how: Any) -> AbstractContextManager[Store]:
        """The open store; see `opened_store`."""
        from hybridlog.cli.app import opened_store

        return opened_store(self.store, self.mongo, **how)


class AsJson(Options):
    """The option of commands that print JSON."""

    as_json: bool = option("Print JSON, for scripts.", name="--json")

    def show(self, rows: Iterable[Any], columns: Sequence[Column], without: str = "") -> None:
        """Print rows as a table or as JSON; without any, a note."""
        if self.as_json:
            output.print_json([*rows])
        elif not (output.is_quiet() or print_table(columns, rows)):
            output.notes(filter(None, [without]))


class Quiet(Options):
    """The option of commands that say more than their answer."""

    quiet: bool = option("No progress, no tables; errors only.", short="-q")


class Forced(Options):
    """The option of commands that write files."""

    force: bool = option("Overwrite existing files.", short="-f")


class Strict(Options):
    """The option of commands that can refuse incomplete answers."""

    strict: bool = option("Fail, with exit code 11, if the ledger knows of losses in this range.")


class Choosing(Options):
    """Options that choose recordings; `names` may be those of an argument of the command."""

    names: ClassVar[tuple[str, ...]] = ()
    recording: tuple[str, ...] = option(
        "Only this recording: name, id, the beginning of one, or a glob such as 'monday*'.",
        "RECORDING",
        short="-r",
    )
    tag: tuple[str, ...] = option("Only recordings with this tag; K alone is any value.", "K=V")
    has: tuple[str, ...] = option("Only recordings with this topic.", "TOPIC")
    types: tuple[str, ...] = option(
        "Only recordings with messages of this type: sensor_msgs/Imu, Imu, or a glob.",
        "TYPE",
        name="--type",
    )
    during: tuple[str, str] | None = option(
        "Only recordings with a time in this range: ISO 8601, epoch seconds, now, start, end.",
        "T0 T1",
        nargs=2,
    )
    last: str | None = option(
        "Only from so long ago until now, such as 30d: recordings, and their messages.",
        "DURATION",
        excludes=("between", "during"),
    )
    older_than: str | None = option(
        "Only recordings whose last message is at least this old, such as 30d.", "DURATION"
    )
    conditions: tuple[str, ...] = option(
        "Only recordings with a message that satisfies this, such as 'scan: ranges.min < 0.5'.",
        "TOPIC: PREDICATE",
        name="--with",
    )

    @property
    def choice(self) -> Choice:
        """The conditions for recordings."""
        during: Any = self.during if self.last is None else (self.since, None)
        return Choice.of(
            (*self.names, *self.recording),
            tag=self.tag,
            has=self.has,
            type=self.types,
            during=during,
            where=self.conditions,
            older_than=self.older_than,
        )

    @property
    def since(self) -> int:
        """The log time at which `--last` begins, ns."""
        from hybridlog.query.times import parse_duration

        return max(time.time_ns() - parse_duration(self.last or 0), 0)

    def recordings_in(self, store: Store) -> Recordings:
        """The chosen recordings; see `recordings_of`."""
        return recordings_of(store, self.choice)


def names_argument(what: str = "Only these recordings", without: str = "all") -> Any:
    """The argument that names recordings; its help says `without` for no name."""
    return argument(f"{what}, as for --recording; without, {without}.", "[RECORDING]...")


class Between(Options):
    """The option of commands about a range of time."""

    between: tuple[str, str] | None = option(
        "From T0 up to, not including, T1: ISO 8601 (UTC without a zone), epoch seconds, "
        "integer nanoseconds, +5s or 1m30s from the start, -10s from the end, start, end.",
        "T0 T1",
        nargs=2,
    )


def topics(
    what: str = "Only this topic: full name, an unambiguous short one (scan), a glob, or re:REGEX.",
) -> Any:
    """The option that names topics."""
    return option(what, "TOPIC", name="--topic", short="-t")


class Ranged(Between, Choosing, InStore, Quiet):
    """Options of commands about a time of some recordings."""

    @property
    def span(self) -> tuple[TimeLike, TimeLike | None] | None:
        """The range of `--between` or `--last`; None for all times."""
        return self.between if self.last is None else (self.since, None)


class Topics(Ranged):
    """Options of commands about messages of some topics."""

    needs_topic: ClassVar[bool] = False
    where: ClassVar[tuple[str, ...]] = ()
    strict: ClassVar[bool] = False
    words: tuple[str, ...] = argument("Topics, as for --topic.", "[TOPIC]...")
    topic: tuple[str, ...] = topics()
    topic_type: tuple[str, ...] = option(
        "Also all topics of this type, such as LaserScan; a glob, too.", "TYPE"
    )

    @property
    def topics(self) -> tuple[str, ...]:
        """The topics as typed."""
        found = (*self.words, *self.topic)
        if self.needs_topic and not (found or self.topic_type):
            raise click.UsageError("Missing TOPIC; `hybridlog info` lists the topics.")
        return found

    def named(self, store: Store) -> tuple[str, ...]:
        """The topics as typed, and those of the types in the chosen recordings."""
        if not self.topic_type:
            return self.topics
        return (*self.topics, *self.recordings_in(store).topics(*self.topic_type))

    def query(self, store: Store) -> Query:
        """The query about these topics, recordings, times and predicates."""
        query = self.bounded(query_of(store, self.named(store), self.choice))
        for predicate in self.where:
            query = query.where(predicate)
        if self.strict:
            query.completeness().check()
        return query

    def bounded(self, query: Query) -> Query:
        """The messages of a query in that range."""
        return query if self.span is None else query.between(*self.span)


class Filtered(Strict, Topics):
    """Options of commands about messages that satisfy predicates."""

    where: tuple[str, ...] = option(  # type: ignore[misc]
        "Only messages that satisfy this, such as 'ranges.min < 0.5 and scan_time > 0', or a "
        "MongoDB filter as JSON.",
        "PREDICATE",
    )


class Served(Options):
    """Options of commands that serve other programs on this computer."""

    port: int | None = option(
        "Port of 127.0.0.1 to serve on, 0 for a free one; without, a free one for the page, 8765 "
        "for viewers that connect.",
        "N",
        type=click.IntRange(0, 65535),
    )


class NoLatched(Options):
    """The option of commands that have messages from before a range of time in front."""

    no_latched: bool = option(
        "With --between: leave out the latched messages and frames of video from before it."
    )


class Latched(NoLatched):
    """Options about messages from before a slice."""

    original_times: bool = option(
        "Latched messages and frames from before the time range keep their log time.",
        excludes=("no_latched",),
    )


def one_recording(
    what: str = "A recording: name, id, or the beginning of one.",
    metavar: str = "RECORDING",
) -> Any:
    """The argument that names one recording."""
    return argument(what, metavar)


def tf_topic(**rules: Any) -> Any:
    """The option for the topics whose transforms count."""
    return option(
        "Transforms of this topic; without, of tf and tf_static of the innermost namespace that "
        "has them.",
        "TOPIC",
        name="--tf-topic",
        **rules,
    )


class InFrame(Options):
    """Options for points and poses in another frame."""

    frame: str | None = option(
        "Points and poses in this frame, such as map, at the times of their headers.",
        "FRAME",
        name="--in-frame",
    )
    tf_topic: tuple[str, ...] = tf_topic(needs=("frame",))

    def placed(self, query: Query) -> Query:
        """The query in that frame, if one is given."""
        if self.frame is None:
            return query
        return query.in_frame(self.frame, tf_topics=self.tf_topic)


def parse_tags(pairs: Iterable[str]) -> dict[str, str]:
    """Tags from KEY=VALUE pairs."""
    tags = {}
    for pair in pairs:
        key, sign, value = pair.partition("=")
        if not sign or not key:
            raise UsageError(f"A tag is written KEY=VALUE, not {pair!r}.")
        tags[key] = value
    return tags


def recordings_of(store: Store, choice: Choice) -> Recordings:
    """The chosen recordings; of an empty store none, if nothing is asked of them."""
    chosen = store.choose(choice)
    return chosen if choice.is_everything else chosen.check()


def query_of(store: Store, topics: Sequence[str] | None, choice: Choice) -> Query:
    """A query of some topics, as typed, of the chosen recordings; without any topic, of all.

    Short names and globs are resolved among the topics of these recordings alone.
    """
    chosen = None if choice.is_everything else recordings_of(store, choice)
    asked = store if chosen is None else chosen
    if not topics:
        return asked.all_topics()
    return asked.topic(*topics)


def parse_fields(text: str, option: str = "--fields") -> list[str]:
    """The names of --fields or a similar option, each once."""
    names = [name.strip() for name in text.split(",")]
    if not all(names):
        raise UsageError(f"{option} takes names with commas between them, not {text!r}.")
    return list(dict.fromkeys(names))
