"""Text from peers, made safe to show."""

from __future__ import annotations

_MAX_LENGTH = 400


def one_line(text: str | bytes, limit: int = _MAX_LENGTH) -> str:
    """Text from a peer as one line: bounded, and without control characters.

    Args:
        text: Text, or bytes that should be UTF-8.
        limit: Number of characters; the rest becomes `...`.
    """
    if isinstance(text, bytes):
        text = text[: limit * 4].decode(errors="replace")
    # The end of a far longer text is not read.
    words = " ".join(text[: limit * 4].split())
    line = words if len(words) <= limit else f"{words[:limit]}..."
    return "".join(char if char.isprintable() else "?" for char in line)
