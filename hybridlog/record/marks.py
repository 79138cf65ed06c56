"""Marks: events as messages on a separate topic, for use in questions."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Final

from hybridlog_storage.messages import Channel, Schema

MARKS: Final = "/hybridlog/marks"
"""Topic of marks."""
CLOCK_SET: Final = "clock"
"""Tag `cause` of marks that a recorder sets when the clock of its machine was set."""
CONTRACT: Final = "contract"
"""Tag `cause` of marks that a recorder sets while a contract is broken."""
MARK: Final = "hybridlog.Mark"
"""Type of marks."""
MARKS_SEGMENT: Final = 10**9
"""Number of the log in memory with the marks that somebody set, behind those of all files."""
MARK_SCHEMA: Final = Schema(
    MARK,
    "jsonschema",
    b'{"type":"object","properties":{"text":{"type":"string"},'
    b'"tags":{"type":"object","additionalProperties":{"type":"string"}},'
    b'"end":{"type":"integer"}}}',
)


def mark_channel() -> Channel:
    """The channel of marks."""
    return Channel(MARKS, "json", MARK_SCHEMA, {})


def mark_payload(text: str, tags: Mapping[str, str], end: int | None = None) -> bytes:
    """A mark as a message, whose log time is the mark's beginning.

    Args:
        text: What happened.
        tags: Tags.
        end: Log time of its end, ns; None for a moment.
    """
    until = {} if end is None else {"end": end}
    content = json.dumps({"text": text, "tags": dict(tags), **until}, ensure_ascii=False)
    # Bytes that are not UTF-8 appear in it as JSON's own escapes.
    return content.encode("utf-8", "backslashreplace")
