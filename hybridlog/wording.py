"""Numbers and lists of names in messages for people."""

from __future__ import annotations

from collections.abc import Iterable

MAX_LISTED = 10


def listed(names: Iterable[str], most: int = MAX_LISTED) -> str:
    """Names with commas between them: `a, b and 4 more` if they are many; `none` without any."""
    known = list(names)
    # One name takes no more room than the words for it.
    if len(known) <= most + 1:
        return ", ".join(known) or "none"
    return f"{', '.join(known[:most])} and {len(known) - most} more"


def counted(number: int, what: str, plural: str | None = None) -> str:
    """`1 message`, `2 messages`."""
    return f"{number} {what if number == 1 else plural or what + 's'}"


def unfit(messages: int) -> str:
    """A number of unreadable messages: `1 message does not fit its definition`."""
    verb = "does not fit its" if messages == 1 else "do not fit their"
    return f"{counted(messages, 'message')} {verb} definition"
