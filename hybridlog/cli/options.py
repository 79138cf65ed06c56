"""Options of commands: a command is bound to the class of its options.

Each field is a parameter of the command; options that several commands share are fields of a base
class, and help shows those of a class before those of its bases. Parameters say which others they
need or exclude, by the names of the fields, and what is typed is checked before the command runs.
"""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from functools import wraps
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, NamedTuple, TypeVar, dataclass_transform

import click
from click.core import ParameterSource

from hybridlog.cli import output
from hybridlog.cli.output import Column, print_table
from hybridlog.query.choice import Choice
from hybridlog.wording import parse_size
from hybridlog_storage.errors import HybridlogError, UsageError

if TYPE_CHECKING:
    from hybridlog.query.query import Query
    from hybridlog.query.times import TimeLike
    from hybridlog.recordings import Recordings
    from hybridlog.store import Store

_Kind = TypeVar("_Kind")
PATH: Final = click.Path(readable=False, path_type=Path)
"""A path that click does not check: the library's errors name a cure and have exit codes."""
_TYPES: Final = {"int": int, "float": float, "Path": PATH}


class Amount(click.ParamType[Any]):
    """A number that is typed with a unit, and read by `parse`; so are its bounds."""

    name = "amount"  # for click

    def __init__(
        self, parse: Callable[[str], float], least: str = "0", most: str | None = None
    ) -> None:
        self.parse, self.least, self.most = parse, least, most

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The number."""
        of = "" if param is None else param.opts[0]
        try:
            found = self.parse(value)
        except HybridlogError as error:
            raise UsageError(f"{of}: {error}") from error
        if found < self.parse(self.least):
            raise UsageError(f"{of} must be at least {self.least}, not {value}.")
        if self.most is not None and found > self.parse(self.most):
            raise UsageError(f"{of} must be at most {self.most}, not {value}.")
        return found


def parse_seconds(text: str) -> float:
    """Seconds from `1m30s`."""
    from hybridlog.query.times import parse_duration

    return parse_duration(text) / 1e9


SIZE: Final = Amount(parse_size)
"""Bytes."""
SECONDS: Final = Amount(parse_seconds)
"""Seconds."""
SOME_SECONDS: Final = Amount(parse_seconds, "1ns")
"""Seconds, more than none."""


_FIRST: Final = ("topic", "between", "where", "fields", "output", "form")
_SECTIONS: Final[dict[str, tuple[str, ...]]] = {
    "Live recording": (),
    "With lerobot": (),
    "Choosing recordings": (
        "recording", "tag", "has", "types", "during", "last", "older_than", "conditions",
    ),
    "Common options": (
        "force", "strict", "as_json", "quiet", "store", "mongo", "_click_default_help",
    ),
}  # fmt: skip
"""Sections of help behind the options of a command alone, and what is in them everywhere."""


class Command(click.Command):
    """A command whose help has sections."""

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """The parameters: those that most people need first, those of all commands last."""
        order = {name: n - len(_FIRST) for n, name in enumerate(_FIRST)}
        order |= {name: n for n, name in enumerate(chain(*_SECTIONS.values()), 1)}
        return sorted(super().get_params(ctx), key=lambda one: order.get(one.name or "", 0))

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options in sections: those of the command alone first."""
        known = {name: title for title, names in _SECTIONS.items() for name in names}
        rows: dict[str, list[tuple[str, str]]] = {title: [] for title in ("Options", *_SECTIONS)}
        for one in self.get_params(ctx):
            record = one.get_help_record(ctx)
            if record is not None and isinstance(one, click.Option):
                title = getattr(one, "section", known.get(one.name or "", "Options"))
                rows[title].append(record)
        for title, found in rows.items():
            if found:
                with formatter.section(title):
                    formatter.write_dl(found)


def _completed(context: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    """Recordings or topics, as help names the value, that begin so; none where that fails."""
    kind = str(param.metavar).strip("[].")
    if kind not in {"RECORDING", "A", "B", "TOPIC"}:
        return []
    from hybridlog_storage.cache import import_numpy_late

    import_numpy_late()
    from hybridlog.store import open_store

    place: Path | None = context.params.get("store")
    try:
        # The shell has not expanded the tilde of the line that is being completed.
        with open_store(place and Path(place).expanduser(), read_only=True) as store:
            names = store.topics() if kind == "TOPIC" else store.recordings().names
    except (HybridlogError, OSError):
        return []
    return [name for name in names if name.startswith(incomplete)]


class _Parameter(NamedTuple):
    """A field of options: makes the parameter of its name and type, and has its rules."""

    make: Callable[[str, str], click.Parameter]
    needs: Sequence[str] = ()
    excludes: Sequence[str] = ()


@dataclass_transform(kw_only_default=True, frozen_default=True)
class Options:
    """A base class of options: its fields are given by name."""

    def __init__(self, **values: Any) -> None:
        self.__dict__.update(values)


def option(
    help: str,  # noqa: A002 - the word of click
    metavar: str | None = None,
    *,
    name: str | None = None,
    short: str | None = None,
    needs: Sequence[str] = (),
    excludes: Sequence[str] = (),
    section: str = "",
    **settings: Any,
) -> Any:
    """A field that is an option; its type says how: `bool` has no value, a tuple is repeatable.

    It needs one of some fields (`viewer=rerun`: with a value) that the command has, and excludes
    others. Settings are those of `click.Option`.
    """

    def make(field: str, annotation: str) -> click.Parameter:
        words = help
        if annotation == "bool":
            settings["is_flag"] = True
        elif annotation.startswith("tuple[") and annotation.endswith(", ...]"):
            settings["multiple"], words = True, f"{help} Repeatable."
        elif (of := annotation.removesuffix(" | None")) in _TYPES:
            settings.setdefault("type", _TYPES[of])
        if "type" not in settings:
            settings["shell_complete"] = _completed
        spelled = [field, name or f"--{field.replace('_', '-')}", *([short] if short else [])]
        made = click.Option(spelled, help=words, metavar=metavar, **settings)
        made.__dict__.update({"section": section} if section else {})
        return made

    return _Parameter(make, needs, excludes)


def argument(
    help: str,  # noqa: A002 - the word of click
    metavar: str,
    **settings: Any,
) -> Any:
    """A field that is an argument; its type says how: a tuple takes any number of words."""

    def make(field: str, annotation: str) -> click.Parameter:
        of = annotation.removesuffix(" | None")
        if of.startswith("tuple["):
            of = of.removeprefix("tuple[").removesuffix(", ...]")
            settings.setdefault("nargs", -1)
        if "type" not in settings and of not in _TYPES:
            settings["shell_complete"] = _completed
        settings.setdefault("type", _TYPES.get(of))
        settings.setdefault("required", None if of == annotation else False)
        return click.Argument([field], help=help, metavar=metavar, **settings)

    return _Parameter(make)


def parameters_of(kind: type) -> list[click.Parameter]:
    """The parameters of a command, those of a class before those of its bases."""
    types: dict[str, str] = {}
    for one in kind.__mro__:
        types = {**types, **inspect.get_annotations(one), **types}
    found = ((getattr(kind, name, None), name, types[name]) for name in types)
    return [one.make(name, of) for one, name, of in found if isinstance(one, _Parameter)]


def check(kind: type, context: click.Context) -> None:
    """Refuse parameters that lack another one, or do not go together."""
    spelled = {
        str(one.name): one.opts[0]
        if isinstance(one, click.Option)
        else str(one.metavar).strip("[].")
        for one in context.command.params
    }
    given = {
        name
        for name in spelled
        if context.get_parameter_source(name) is ParameterSource.COMMANDLINE
        and context.params[name] not in (None, (), False)
    }
    values = {f"{name}={value}" for name, value in context.params.items()}
    for field, one in ((each, getattr(kind, each)) for each in spelled if each in given):
        name = spelled[field]
        needs = [each.partition("=") for each in one.needs if each.partition("=")[0] in spelled]
        if needs and not (given | values).intersection(one.needs):
            others = " or ".join(value or spelled[each] for each, _, value in needs)
            raise UsageError(f"{name} is for {others}: add that, or leave out {name}.")
        for other in filter(given.__contains__, one.excludes):
            raise UsageError(
                f"{name} and {spelled[other]} exclude each other: leave out one of them."
            )


def command(
    kind: type[_Kind], name: str | None = None, to: click.Group | None = None
) -> Callable[[Callable[[_Kind], int | None]], click.Command]:
    """Make a function a command: it gets its options, and may give an exit code."""

    def bound(function: Callable[[_Kind], int | None]) -> click.Command:
        @wraps(function)
        def call(**values: Any) -> None:
            check(kind, click.get_current_context())
            given = kind(**values)
            output.begin(given)
            if code := function(given):
                raise click.exceptions.Exit(code)

        call.__click_params__ = parameters_of(kind)[::-1]  # type: ignore[attr-defined]
        made = click.command(name, cls=Command)(call)
        if to is not None:
            to.add_command(made)
        return made

    return bound


# Options that several commands share.


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
