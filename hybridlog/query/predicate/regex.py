"""Regular expressions of RE2: every match takes linear time and bounded memory."""

from __future__ import annotations

import re
from functools import lru_cache
from typing import TypeAlias

MAX_LENGTH = 1_000
"""Maximum length of a pattern, characters."""
_MAX_BYTES = 8 << 20  # of a compiled pattern; Arrow has the same limit
_ESCAPE = re.compile(r"\\Q.*?(?:\\E|\Z)|\\(.)", re.DOTALL)


class RegexError(ValueError):
    """The reason why a pattern is refused."""


Regex: TypeAlias = "re.Pattern[str]"
"""A compiled pattern, which has `search` and `fullmatch` as one of Python has."""


@lru_cache(maxsize=256)
def compile_regex(pattern: str, max_length: int = MAX_LENGTH) -> Regex:
    """Compile a pattern in RE2's syntax.

    Args:
        pattern: The pattern as the user wrote it.
        max_length: Maximum length of the pattern, characters.
    """
    if len(pattern) > max_length:
        raise RegexError(f"longer than {max_length} characters")
    if any(escape[1] == "C" for escape in _ESCAPE.finditer(pattern)):
        raise RegexError("\\C matches a byte, and strings are characters")
    import re2

    options = re2.Options()
    options.max_mem = _MAX_BYTES
    options.log_errors = False
    try:
        pattern.encode()
        return re2.compile(pattern, options)  # type: ignore[no-any-return]
    except UnicodeEncodeError:
        raise RegexError("is not valid Unicode") from None
    except re2.error as error:
        told = error.args[0]  # such as `missing ): (a`
        text = told.decode(errors="replace") if isinstance(told, bytes) else str(told)
        shown = "".join(char if char.isprintable() else "?" for char in text)
        raise RegexError(
            f"{shown}; patterns have RE2's syntax, without looking around and back references"
        ) from None
