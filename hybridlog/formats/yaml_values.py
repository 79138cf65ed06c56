"""Parses YAML of unknown origin in bounded time and memory.

libyaml limits nesting and splits the text into events; these become plain values. Aliases
share one value, and merge keys are ordinary keys, so nothing grows beyond the text.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Collection

MAX_BYTES: Final = 1 << 20
"""Most bytes of a file that a user writes by hand."""
MAX_EVENTS = 2_000_000
"""Most keys, values, and starts and ends of lists and mappings; parsed in about 2 s."""

_INTEGER = re.compile(r"[-+]?[0-9]{1,20}")
_WORDS = {"": None, "~": None, "null": None, "true": True, "false": False}
_NO_KEY = object()


class YamlError(ValueError):
    """The text is not YAML, or too much of it; the message is the reason."""


def read_yaml(path: str | Path, what: str) -> bytes:
    """Read a small file of a user that is to be parsed."""
    try:
        with Path(path).open("rb") as file:
            text = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror}.") from error
    if len(text) > MAX_BYTES:
        raise UsageError(f"{path} is larger than 1 MiB: no {what}.")
    return text


def parse_yaml(
    text: str | bytes,
    wanted: Collection[str] | None = None,
    *,
    lines: dict[tuple[int, object], int] | None = None,
) -> object:
    """Parse the first document of a text; fractions are strings.

    Only `wanted` keys of mappings are kept, at any depth; None for all. `lines` gets the line of
    each key, by the `id` of its mapping and the key. A key that is not a single word or is repeated
    raises YamlError, as too much text does.
    """
    import yaml

    values = _Values(wanted, {} if lines is None else lines)
    starts = {yaml.MappingStartEvent: dict, yaml.SequenceStartEvent: list}
    ends = {yaml.MappingEndEvent, yaml.SequenceEndEvent}
    skipped = 0  # depth within an unwanted value
    try:
        for number, event in enumerate(yaml.parse(text, Loader=yaml.CSafeLoader)):
            kind = type(event)
            if number > MAX_EVENTS:
                raise YamlError(f"it has more than {MAX_EVENTS} keys and values")
            values.line = event.start_mark.line + 1
            if skipped:
                skipped += (kind in starts) - (kind in ends)
            elif kind in starts:
                skipped += not values.start(starts[kind](), event.anchor)
            elif kind in ends:
                values.end()
            elif kind is yaml.ScalarEvent:
                values.add(_scalar(event), event.anchor)
            elif kind is yaml.AliasEvent:
                values.alias(event.anchor)
            elif kind is yaml.DocumentEndEvent:
                break
    except (yaml.YAMLError, UnicodeEncodeError) as error:
        raise YamlError(" ".join(str(error).split())[:200]) from error
    return values.root[0] if values.root else None


class _Values:
    """Makes values of events."""

    def __init__(
        self, wanted: Collection[str] | None, lines: dict[tuple[int, object], int]
    ) -> None:
        self.root: list[object] = []
        self.line = 0
        self._lines = lines
        self._wanted = wanted
        self._open: list[Any] = [self.root]
        self._keys: list[object] = [_NO_KEY]  # of the open mappings, each waiting for a value
        self._anchors: dict[str, object] = {}

    def start(self, value: Any, anchor: str | None) -> bool:
        """Start a list or mapping; False if it is unwanted."""
        if not self.add(value, anchor):
            return False
        self._open.append(value)
        self._keys.append(_NO_KEY)
        return True

    def end(self) -> None:
        self._open.pop()
        self._keys.pop()

    def alias(self, anchor: str) -> None:
        self._place(self._anchors.get(anchor))

    def add(self, value: object, anchor: str | None) -> bool:
        """Add a value; False if it is unwanted."""
        if not self._place(value):
            return False
        if anchor is not None:
            self._anchors[anchor] = value
        return True

    def _place(self, value: object) -> bool:
        """Add a value to the innermost list or mapping; False if it is unwanted."""
        holder, key = self._open[-1], self._keys[-1]
        if isinstance(holder, list):
            holder.append(value)
            return True
        if key is _NO_KEY:
            if isinstance(value, dict | list):
                raise YamlError("a key is a list or a mapping")
            self._keys[-1] = value
            self._lines[id(holder), value] = self.line
            return True
        self._keys[-1] = _NO_KEY
        if self._wanted is not None and key not in self._wanted:
            return False
        if key in holder:
            raise YamlError(f"the key {key!r} is repeated")
        holder[key] = value
        return True


def _scalar(event: Any) -> object:
    text: str = event.value
    if not event.implicit[0]:  # quoted, or with a tag
        return text
    if text.lower() in _WORDS:
        return _WORDS[text.lower()]
    return int(text) if _INTEGER.fullmatch(text) else text
