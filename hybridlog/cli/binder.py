"""Binds a command to the dataclass of its options: each field is a parameter of the command.

Options that several commands share are fields of a base class. Help shows those of a class
before those of its bases.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import field, fields
from functools import wraps
from pathlib import Path
from typing import Any, Final, TypeVar

import click

from hybridlog.cli.hints import Command, Pair

_MAKE: Final = "hybridlog.parameter"
_Kind = TypeVar("_Kind")
PATH: Final = click.Path(readable=False, path_type=Path)
"""A path that click does not check: the library's errors name a cure and have exit codes."""
_TYPES: Final = {"int": int, "float": float, "Path": PATH}


def option(
    help: str,  # noqa: A002 - the word of click
    metavar: str | None = None,
    *,
    name: str | None = None,
    short: str | None = None,
    kind: type[click.Option] = click.Option,
    **settings: Any,
) -> Any:
    """A field that is an option; its type says how: `bool` has no value, a tuple is repeatable.

    Args:
        help: What it does.
        metavar: What its value is called.
        name: Its long spelling; without, made from the name of the field.
        short: Its short spelling.
        kind: Its class.
        settings: Of the class.
    """

    def make(field: str, annotation: str) -> click.Parameter:
        words = help
        if annotation == "bool":
            settings["is_flag"] = True
        elif annotation == "tuple[str, ...]":
            settings["multiple"], words = True, f"{help} Repeatable."
        elif (of := annotation.removesuffix(" | None")) in _TYPES:
            settings.setdefault("type", _TYPES[of])
        made = Pair if settings.get("nargs") == 2 else kind
        spelled = [field, name or f"--{field.replace('_', '-')}", *([short] if short else [])]
        return made(spelled, help=words, metavar=metavar, **settings)

    return field(metadata={_MAKE: make})


def argument(help: str, metavar: str, **settings: Any) -> Any:  # noqa: A002
    """A field that is an argument; its type says how: a tuple takes any number of words.

    Args:
        help: What it is.
        metavar: What the usage line calls it.
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
            return function(kind(**values))

        call.__click_params__ = parameters_of(kind)[::-1]  # type: ignore[attr-defined]
        make: Any = click.command(name, **{"cls": Command, **settings})
        made: click.Command = make(call)
        if to is not None:
            to.add_command(made)
        return made

    return bound
