"""Binds a command to the dataclass of its options: each field is a parameter of the command.

Options that several commands share are fields of a base class. Help shows those of a class
before those of its bases.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import field, fields
from functools import wraps
from typing import Any, Final, TypeVar

import click

_MAKE: Final = "hybridlog.parameter"
_Kind = TypeVar("_Kind")


def option(*names: str, kind: type[click.Option] = click.Option, **settings: Any) -> Any:
    """A field that is an option, called as the field is.

    Args:
        names: Its spellings.
        kind: Its class.
        settings: Of the class.
    """
    return field(metadata={_MAKE: lambda name: kind([name, *names], **settings)})


def repeated(*names: str, **settings: Any) -> Any:
    """An option that may be given several times; the field is a tuple."""
    settings["help"] += " Repeatable."
    return option(*names, multiple=True, **settings)


def flag(*names: str, help: str, **settings: Any) -> Any:  # noqa: A002 - the word of click
    """An option without a value; the field is a bool."""
    return option(*names, is_flag=True, help=help, **settings)


def argument(**settings: Any) -> Any:
    """A field that is an argument; its metavar is in the usage line."""
    return field(metadata={_MAKE: lambda name: click.Argument([name], **settings)})


def parameters_of(kind: type) -> list[click.Parameter]:
    """The parameters of a command, those of a class before those of its bases."""
    names = dict.fromkeys(name for one in kind.__mro__ for name in inspect.get_annotations(one))
    made = {one.name: one.metadata.get(_MAKE) for one in fields(kind)}
    return [make(name) for name in names if (make := made.get(name)) is not None]


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
        parameters = parameters_of(kind)
        own = [str(parameter.name) for parameter in parameters]

        @wraps(function)
        def call(**values: Any) -> Any:
            return function(kind(**{name: values.pop(name) for name in own}), **values)

        known = getattr(function, "__click_params__", [])
        call.__click_params__ = [*known, *reversed(parameters)]  # type: ignore[attr-defined]
        make: Any = click.command(name, **settings)
        made: click.Command = make(call)
        if to is not None:
            to.add_command(made)
        return made

    return bound
