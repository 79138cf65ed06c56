"""Infers the fields of a topic without a definition from its first messages."""

from __future__ import annotations

import re
from collections.abc import Iterable
from itertools import islice
from typing import TYPE_CHECKING

from hybridlog_storage.errors import PayloadError

if TYPE_CHECKING:
    from hybridlog.message import Message

SAMPLE = 100
"""Messages that are read."""
_MAX_FIELDS = 1000
_MAX_DEPTH = 50
_WORDS = ((bool, "bool"), (int, "integer"), (float, "number"), (str, "string"))
_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


def infer_fields(messages: Iterable[Message]) -> list[dict[str, object]]:
    """Paths and types of the fields that the first messages have, in their order.

    Args:
        messages: Messages in JSON; those that cannot be read are skipped.

    Returns:
        `path` as a predicate takes it, `type` (several joined by `|`), and whether a
        message may hold several values there.
    """
    found: dict[str, tuple[set[str], bool]] = {}
    for message in islice(messages, SAMPLE):
        try:
            _visit(message.decode(), "", found, within_array=False)
        except PayloadError:
            continue
    return [
        {"path": path, "type": _spelled(kinds), "array": array}
        for path, (kinds, array) in found.items()
    ]


def _visit(
    value: object, path: str, found: dict[str, tuple[set[str], bool]], *, within_array: bool
) -> None:
    if path.count(".") >= _MAX_DEPTH:
        return
    if isinstance(value, dict):
        for name, item in value.items():
            plain = _PLAIN.fullmatch(name) is not None
            part = name if plain else f"`{name}`"
            below = f"{path}.{part}" if path else part
            if below not in found and len(found) >= _MAX_FIELDS:
                return
            kinds, array = found.get(below, (set(), within_array))
            kinds.add(_kind(item))
            found[below] = kinds, array or isinstance(item, list)
            _visit(item, below, found, within_array=within_array)
    elif isinstance(value, list) and path:
        for item in value:
            if isinstance(item, dict):
                _visit(item, f"{path}[]", found, within_array=True)


def _spelled(kinds: set[str]) -> str:
    # In JSON, 1 is also a number, without a fraction.
    return "|".join(sorted(kinds - {"integer"} if "number" in kinds else kinds))


def _kind(value: object) -> str:
    if isinstance(value, list):
        inner = _spelled({_kind(item) for item in value})
        return "array" if not inner or "|" in inner else f"{inner}[]"
    if isinstance(value, dict):
        return "object"
    return next((word for kind, word in _WORDS if isinstance(value, kind)), "null")
