"""Binds a command to the dataclass of its options: each field is a parameter of the command.

Options that several commands share are fields of a base class. Help shows those of a class
before those of its bases. Parameters say which others they need or exclude, by the names of the
fields, and what is typed is checked before the command runs.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from functools import wraps
from pathlib import Path
from typing import Any, Final, TypeVar

import click
from click.core import ParameterSource

from hybridlog.cli.hints import Command, Pair
from hybridlog.wording import parse_size
from hybridlog_storage.errors import HybridlogError, UsageError

_MAKE, _NEEDS, _EXCLUDES = "hybridlog.parameter", "hybridlog.needs", "hybridlog.excludes"
_Kind = TypeVar("_Kind")
PATH: Final = click.Path(readable=False, path_type=Path)
"""A path that click does not check: the library's errors name a cure and have exit codes."""
_TYPES: Final = {"int": int, "float": float, "Path": PATH}


@dataclass(frozen=True)
class Amount(click.ParamType[Any]):
    """A number that is typed with a unit.

    Attributes:
        parse: Gives the number of a text.
        least: The least number that is allowed, as typed.
        most: The greatest one; None for any.
    """

    parse: Callable[[str], float]
    least: str = "0"
    most: str | None = None
    name: str = "amount"  # for click

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The number.

        Raises:
            UsageError: The text is none, or it is out of range.
        """
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
    """Seconds from `1m30s`.

    Raises:
        TimeError: The text is no duration.
    """
    from hybridlog.query.times import parse_duration

    return parse_duration(text) / 1e9


SIZE: Final = Amount(parse_size)
"""Bytes."""
SECONDS: Final = Amount(parse_seconds)
"""Seconds."""
SOME_SECONDS: Final = Amount(parse_seconds, "1ns")
"""Seconds, more than none."""


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

    Args:
        help: What it does.
        metavar: What its value is called.
        name: Its long spelling; without, made from the name of the field.
        short: Its short spelling.
        needs: Parameters, one of which has to be given, too, of those that the command has;
            `viewer=rerun` is one with a value.
        excludes: Parameters that must not be given besides.
        section: Of the help.
        settings: Of `click.Option`.
    """

    def make(field: str, annotation: str) -> click.Parameter:
        words = help
        if annotation == "bool":
            settings["is_flag"] = True
        elif annotation.startswith("tuple[") and annotation.endswith(", ...]"):
            settings["multiple"], words = True, f"{help} Repeatable."
        elif (of := annotation.removesuffix(" | None")) in _TYPES:
            settings.setdefault("type", _TYPES[of])
        kind: Any = Pair if settings.get("nargs") == 2 else click.Option
        spelled = [field, name or f"--{field.replace('_', '-')}", *([short] if short else [])]
        made: click.Option = kind(spelled, help=words, metavar=metavar, **settings)
        made.__dict__.update({"section": section} if section else {})
        return made

    return field(metadata={_MAKE: make, _NEEDS: needs, _EXCLUDES: excludes})


def argument(
    help: str,  # noqa: A002 - the word of click
    metavar: str,
    *,
    excludes: Sequence[str] = (),
    **settings: Any,
) -> Any:
    """A field that is an argument; its type says how: a tuple takes any number of words.

    Args:
        help: What it is.
        metavar: What the usage line calls it.
        excludes: As for `option`.
        settings: Of `click.Argument`.
    """

    def make(field: str, annotation: str) -> click.Parameter:
        of = annotation.removesuffix(" | None")
        if of.startswith("tuple["):
            of = of.removeprefix("tuple[").removesuffix(", ...]")
            settings.setdefault("nargs", -1)
        settings.setdefault("type", _TYPES.get(of))
        settings.setdefault("required", None if of == annotation else False)
        return click.Argument([field], help=help, metavar=metavar, **settings)

    return field(metadata={_MAKE: make, _EXCLUDES: excludes})


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
    """Refuse parameters that lack another one, or do not go together.

    Raises:
        UsageError: They do.
    """
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
) -> Callable[[Callable[..., Any]], click.Command]:
    """Make a function a command; it gets an instance of the class of its options.

    Args:
        kind: A dataclass of the fields above.
        name: Name of the command; without, that of the function.
        to: The group that it belongs to.
        settings: Of `click.command`.
    """

    def bound(function: Callable[..., Any]) -> click.Command:
        @wraps(function)
        def call(**values: Any) -> Any:
            check(kind, click.get_current_context())
            return function(kind(**values))

        call.__click_params__ = parameters_of(kind)[::-1]  # type: ignore[attr-defined]
        make: Any = click.command(name, **{"cls": Command, **settings})
        made: click.Command = make(call)
        if to is not None:
            to.add_command(made)
        return made

    return bound
