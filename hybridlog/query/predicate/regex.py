"""Regular expressions of RE2: every match takes linear time and bounded memory."""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Protocol

MAX_LENGTH = 1_000
"""Maximum length of a pattern, characters."""
_MAX_BYTES = 8 << 20  # of a compiled pattern; Arrow has the same limit
_ESCAPE = re.compile(r"\\Q.*?(?:\\E|\Z)|\\(.)", re.DOTALL)


class RegexError(ValueError):
    """The reason why a pattern is refused.

    Attributes:
        position: Index of the offending character.
    """

    def __init__(self, reason: str, position: int = 0) -> None:
        super().__init__(reason)
        self.position = position


class Regex(Protocol):
    """A compiled pattern."""

    def search(self, text: str) -> object | None:
        """A match anywhere in the text, None when there is none."""

    def fullmatch(self, text: str) -> object | None:
        """A match of the whole text, None when there is none."""


@lru_cache(maxsize=256)
def compile_regex(pattern: str, max_length: int = MAX_LENGTH) -> Regex:
    """Compile a pattern in RE2's syntax.

    Args:
        pattern: The pattern as the user wrote it.
        max_length: Maximum length of the pattern, characters.
    """
    if len(pattern) > max_length:
        raise RegexError(f"longer than {max_length} characters", max_length)
    import re2

    options = re2.Options()
    options.max_mem = _MAX_BYTES
    options.log_errors = False
    try:
        pattern.encode()
        compiled: Regex = re2.compile(pattern, options)
    except UnicodeEncodeError as error:
        raise RegexError("is not valid Unicode", error.start) from None
    except re2.error as error:
        raise _refusal(pattern, error.args[0]) from None
    for escape in _ESCAPE.finditer(pattern):
        if escape[1] == "C":
            raise RegexError("\\C matches a byte, and strings are characters", escape.start())
    return compiled


def _refusal(pattern: str, reported: bytes | str) -> RegexError:
    """The error for a message of RE2, such as `missing ): (a`."""
    text = reported.decode(errors="replace") if isinstance(reported, bytes) else str(reported)
    reason, _, fault = text.partition(": ")
    place = max(pattern.find(fault), 0) if fault else 0
    shown = "".join(char if char.isprintable() else "?" for char in text)
    if reason == "invalid perl operator" or (
        reason == "invalid escape sequence" and fault[1:].isdigit()
    ):
        shown += "; patterns have RE2's syntax, without looking around and back references"
    return RegexError(f"not a regular expression of RE2: {shown}", place)
