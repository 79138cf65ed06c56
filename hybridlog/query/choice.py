"""A choice of recordings: the conditions that they must satisfy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, TypeAlias

from msgspec import Struct

from hybridlog_storage.errors import TimeError, UsageError

if TYPE_CHECKING:
    from hybridlog.query.times import DurationLike, TimeLike

Texts: TypeAlias = "str | Sequence[str] | None"
"""One text or several."""
Tags: TypeAlias = "str | Sequence[str] | Mapping[str, str | None] | None"
"""`"robot=7"`, `"robot"`, several of these, or values by key."""
During: TypeAlias = "tuple[TimeLike | None, TimeLike | None] | None"
"""Begin and end of a range of log time; None leaves a side open."""


class Choice(Struct, frozen=True):
    """Conditions for recordings; all of them must hold, and one of the names must match.

    Attributes:
        name: Names, ids, beginnings of one, globs.
        tag: Keys and values of tags; None for any value.
        has: Topics that they have, as patterns.
        type: Types of messages that they have.
        during: Range `[begin, end)` of log time that they overlap.
        where: `TOPIC: PREDICATE`; each holds for at least one of their messages.
        older_than: Age that their last message has at least.
    """

    name: tuple[str, ...] = ()
    tag: tuple[tuple[str, str | None], ...] = ()
    has: tuple[str, ...] = ()
    type: tuple[str, ...] = ()
    during: tuple[TimeLike | None, TimeLike | None] | None = None
    where: tuple[str, ...] = ()
    older_than: DurationLike | None = None

    @classmethod
    def of(
        cls,
        name: Texts = None,
        *,
        tag: Tags = None,
        has: Texts = None,
        type: Texts = None,  # noqa: A002 - the word of the command line
        during: During = None,
        where: Texts = None,
        older_than: DurationLike | None = None,
    ) -> Choice:
        """A choice from single values or several.

        Raises:
            UsageError: A tag has no key.
            TimeError: `during` is not a pair.
        """
        if during is not None and (isinstance(during, str) or len(during) != 2):
            raise TimeError(f"A range takes two times, (begin, end), not {during!r}.")
        return cls(
            _texts(name),
            _tags(tag),
            _texts(has),
            _texts(type),
            None if during is None else (during[0], during[1]),
            _texts(where),
            older_than,
        )

    @property
    def is_everything(self) -> bool:
        """True if there is no condition."""
        return self == Choice()


def _texts(given: Texts) -> tuple[str, ...]:
    if given is None:
        return ()
    found = (given,) if isinstance(given, str) else tuple(given)
    if not all(isinstance(one, str) for one in found):
        raise UsageError(f"A choice of recordings takes text, not {given!r}.")
    return found


def _tags(given: Tags) -> tuple[tuple[str, str | None], ...]:
    pairs: list[tuple[str, str | None]]
    if isinstance(given, Mapping):
        pairs = list(given.items())
    else:
        split = (one.partition("=") for one in _texts(given))
        pairs = [(key, value if sign else None) for key, sign, value in split]
    for key, _ in pairs:
        if not key:
            raise UsageError("A tag is chosen as KEY=VALUE, or as KEY for any value.")
    return tuple(pairs)
