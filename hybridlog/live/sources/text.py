"""What peers say, for people to read. The child in ROS 2's own Python uses it, too."""

from __future__ import annotations

_MOST = 400


def one_line(text: str | bytes, most: int = _MOST) -> str:
    """Text from elsewhere as one line: not too long, nothing that a terminal acts on.

    Args:
        text: Bytes are taken for UTF-8, as far as they are.
        most: Characters that are shown.
    """
    if isinstance(text, bytes):
        text = text[: most * 4].decode(errors="replace")
    # What is far longer than a line is not looked at to its end.
    words = " ".join(text[: most * 4].split())
    line = words if len(words) <= most else f"{words[:most]}..."
    return "".join(char if char.isprintable() else "?" for char in line)
