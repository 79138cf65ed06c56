"""Binds a command to the dataclass of its options: each field is a parameter of the command.

Options that several commands share are fields of a base class. Help shows those of a class
before those of its bases. Parameters say which others they need or exclude, by the names of the
fields, and what is typed is checked before the command runs.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import Field, dataclass, field, fields
from functools import wraps
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar, Final, TypeVar, dataclass_transform

import click
from click.core import ParameterSource

from hybridlog.cli import output
from hybridlog.wording import parse_size
from hybridlog_storage.errors import HybridlogError, UsageError

_MAKE, _NEEDS, _EXCLUDES = "hybridlog.parameter", "hybridlog.needs", "hybridlog.excludes"
_Kind = TypeVar("_Kind")
PATH: Final = click.Path(readable=False, path_type=Path)
"""A path that click does not check: the library's errors name a cure and have exit codes."""
_TYPES: Final = {"int": int, "float": float, "Path": PATH}


@dataclass(frozen=True)
class Amount(click.ParamType[Any]):
    """A number that is typed with a unit, and read by `parse`; so are its bounds."""

    parse: Callable[[str], float]
    least: str = "0"
    most: str | None = None
    name: str = "amount"  # for click

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
    from hybridlog.opened import OpenStore
    from hybridlog.store import store_path
    from hybridlog_storage.remote import directory_of

    try:
        value: Path | None = context.params.get("store")
        # The shell has not expanded the tilde of the line that is being completed.
        path = store_path(None if value is None else Path(value).expanduser())
        with closing(OpenStore(directory_of(path), "none", None)) as shared:
            snapshot = shared.now().look()
            names = [one.name for one in snapshot.summaries]
            if kind == "TOPIC":
                names = snapshot.topics
    except (HybridlogError, OSError):
        return []
    return [name for name in names if name.startswith(incomplete)]


@dataclass_transform(kw_only_default=True, frozen_default=True)
class Options:
    """A base class of options: each class below it is a frozen dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def __init_subclass__(cls) -> None:
        """Make a class a dataclass, whose fields are given by name."""
        dataclass(frozen=True, kw_only=True)(cls)


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

    return field(metadata={_MAKE: make, _NEEDS: needs, _EXCLUDES: excludes})


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

    return field(metadata={_MAKE: make})


def parameters_of(kind: type) -> list[click.Parameter]:
    """The parameters of a command, those of a class before those of its bases."""
    types: dict[str, str] = {}
    for one in kind.__mro__:
        for name, annotation in inspect.get_annotations(one).items():
            types.setdefault(name, annotation)
    made = {one.name: one.metadata.get(_MAKE) for one in fields(kind)}
    return [
        make(name, annotation)
        for name, annotation in types.items()
        if (make := made.get(name)) is not None
    ]


def check(kind: type, context: click.Context) -> None:
    """Refuse parameters that lack another one, or do not go together."""
    parameters = {str(one.name): one for one in context.command.params}
    given = {
        name
        for name in parameters
        if context.get_parameter_source(name) is ParameterSource.COMMANDLINE
        and context.params[name] not in (None, (), False)
    }

    def spelled(name: str) -> str:
        name, _, value = name.partition("=")
        one = parameters[name]
        return value or (
            one.opts[0] if isinstance(one, click.Option) else str(one.metavar).strip("[].")
        )

    def is_given(name: str) -> bool:
        name, _, value = name.partition("=")
        return context.params[name] == value if value else name in given

    for one in (each for each in fields(kind) if each.name in given):
        name = spelled(one.name)
        needs = [n for n in one.metadata.get(_NEEDS, ()) if n.partition("=")[0] in parameters]
        if needs and not any(map(is_given, needs)):
            others = " or ".join(map(spelled, needs))
            raise UsageError(f"{name} is for {others}: add that, or leave out {name}.")
        for other in filter(given.__contains__, one.metadata.get(_EXCLUDES, ())):
            raise UsageError(
                f"{name} and {spelled(other)} exclude each other: leave out one of them."
            )


def command(
    kind: type[_Kind], name: str | None = None, to: click.Group | None = None, **settings: Any
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
        make: Any = click.command(name, **{"cls": Command, **settings})
        made: click.Command = make(call)
        if to is not None:
            to.add_command(made)
        return made

    return bound
