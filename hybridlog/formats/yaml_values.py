"""Parses YAML of unknown origin in bounded time and memory.

libyaml limits nesting and splits the text into events; these become plain values. Aliases
share one value, and merge keys are ordinary keys, so nothing grows beyond the text.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from hybridlog_storage.errors import UsageError

MAX_BYTES: Final = 1 << 20
"""Most bytes of a file that a user writes by hand."""
MAX_EVENTS = 1_000_000
"""Most keys, values, and starts and ends of lists and mappings; parsed in about 1 s."""

_INTEGER = re.compile(r"[-+]?[0-9]{1,20}")
_WORDS = {"": None, "~": None, "null": None, "true": True, "false": False}


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


def parse_yaml(text: str | bytes) -> object:
    """Parse the first document of a text; fractions are strings.

    A key that is not a single word or is repeated raises YamlError, as too much text does.
    """
    import yaml

    numbered = enumerate(yaml.parse(text, Loader=yaml.CSafeLoader))

    def take() -> Any:
        number, event = next(numbered)
        if number > MAX_EVENTS:
            raise YamlError(f"it has more than {MAX_EVENTS} keys and values")
        return event

    try:
        take()
        if isinstance(take(), yaml.StreamEndEvent):
            return None
        return _value(take(), take, {})
    except (yaml.YAMLError, UnicodeEncodeError) as error:
        raise YamlError(" ".join(str(error).split())[:200]) from error
    except RecursionError:
        raise YamlError("its nesting depth is too great") from None


def _value(event: Any, take: Callable[[], Any], anchors: dict[str | None, object]) -> Any:
    """The value that this event begins, and the following ones complete."""
    import yaml

    if isinstance(event, yaml.AliasEvent):
        return anchors.get(event.anchor)
    if isinstance(event, yaml.ScalarEvent):
        anchors[event.anchor] = text = _scalar(event)
        return text
    is_list = isinstance(event, yaml.SequenceStartEvent)
    found: Any = [] if is_list else {}
    anchors[event.anchor] = found
    while not isinstance(item := take(), yaml.CollectionEndEvent):
        if is_list:
            found.append(_value(item, take, anchors))
            continue
        is_word = isinstance(item, yaml.ScalarEvent | yaml.AliasEvent)
        key = _value(item, take, anchors) if is_word else found
        if isinstance(key, dict | list):
            raise YamlError("a key is a list or a mapping")
        if key in found:
            raise YamlError(f"the key {key!r} is repeated")
        found[key] = _value(take(), take, anchors)
    return found


def _scalar(event: Any) -> object:
    text: str = event.value
    if not event.implicit[0]:  # quoted, or with a tag
        return text
    if text.lower() in _WORDS:
        return _WORDS[text.lower()]
    return int(text) if _INTEGER.fullmatch(text) else text
