"""Reads the parameters of a request. Each has a bound, and none is guessed."""

from __future__ import annotations

import re
from collections.abc import Collection
from typing import TYPE_CHECKING, Final, NoReturn

from hybridlog.query.times import TIME_LIMIT
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from starlette.datastructures import QueryParams

MAX_OFFSET: Final = TIME_LIMIT - 1
"""Greatest time since the start of a recording, ns."""
MAX_PIXELS: Final = 8192
"""Greatest width that is drawn."""

_INTEGER: Final = re.compile(r"-?\d{1,19}", re.ASCII)


class RequestParams:
    """The parameters of one request.

    Args:
        parameters: As in the URL.
        tag: Entity tag of the answer that the browser has already; None for none.

    Attributes:
        tag: That tag.
    """

    def __init__(self, parameters: QueryParams, tag: str | None = None) -> None:
        self._parameters = parameters
        self.tag = tag

    def has(self, name: str) -> bool:
        """True if a parameter is given."""
        return name in self._parameters

    def text(self, name: str, default: str | None = None, *, longest: int = 1024) -> str:
        """A text.

        Args:
            name: Name of the parameter.
            default: The text if it is not given; None if it must be.
            longest: Greatest number of characters.

        Raises:
            UsageError: It is missing, too long, or given twice.
        """
        found = self._one(name)
        if found is None:
            return _missing(name) if default is None else default
        if len(found) > longest:
            raise UsageError(f"{name} is too long: {len(found)} characters, at most {longest}.")
        return found

    def texts(self, name: str, *, most: int, longest: int = 1024) -> list[str]:
        """All values of a parameter that may be repeated.

        Raises:
            UsageError: There are more than `most`, or one is longer than `longest`.
        """
        found = self._parameters.getlist(name)
        if len(found) > most:
            raise UsageError(f"{name} is given {len(found)} times, at most {most} are possible.")
        if any(len(text) > longest for text in found):
            raise UsageError(f"A value of {name} is longer than {longest} characters.")
        return found

    def word(self, name: str, words: Collection[str], default: str) -> str:
        """One of some words.

        Raises:
            UsageError: It is none of them.
        """
        found = self.text(name, default)
        if found not in words:
            raise UsageError(f"{name} is one of {', '.join(words)}.")
        return found

    def integer(self, name: str, least: int, most: int, default: int | None = None) -> int:
        """A whole number between two bounds, both inclusive.

        Args:
            name: Name of the parameter.
            least: Least value.
            most: Greatest value.
            default: The value if it is not given; None if it must be.

        Raises:
            UsageError: It is missing, no whole number, or out of bounds.
        """
        text = self._one(name)
        if text is None:
            return _missing(name) if default is None else default
        if not _INTEGER.fullmatch(text) or not least <= int(text) <= most:
            raise UsageError(f"{name} is a whole number from {least} to {most}.")
        return int(text)

    def pixels(self) -> int:
        """The width of the picture, from 1 to `MAX_PIXELS`.

        Raises:
            UsageError: It is missing or out of bounds.
        """
        return self.integer("pixels", 1, MAX_PIXELS)

    def offset(self, name: str) -> int:
        """A time since the start of the recording, ns.

        Raises:
            UsageError: It is missing, no whole number, or out of bounds.
        """
        return self.integer(name, -MAX_OFFSET, MAX_OFFSET)

    def moment(self, start: int) -> int:
        """The time `at`, ns since 1970, cut to what is a time.

        Args:
            start: The time that offsets count from.

        Raises:
            UsageError: It is missing, no whole number, or out of bounds.
        """
        return min(max(start + self.offset("at"), 0), TIME_LIMIT - 1)

    def span(self, start: int) -> tuple[int, int]:
        """The range from `begin` to `end`, ns since 1970, cut to what is a time; never empty.

        Args:
            start: The time that offsets count from.

        Raises:
            UsageError: A bound is missing, no whole number or out of bounds, or it is empty.
        """
        begin, end = self.offset("begin"), self.offset("end")
        if end <= begin:
            raise UsageError("end is greater than begin.")
        last = TIME_LIMIT - 1
        return min(max(start + begin, 0), last - 1), min(max(start + end, 1), last)

    def _one(self, name: str) -> str | None:
        found = self._parameters.getlist(name)
        if len(found) > 1:
            raise UsageError(f"{name} is given {len(found)} times.")
        return found[0] if found else None


def _missing(name: str) -> NoReturn:
    raise UsageError(f"The parameter {name} is missing.")
