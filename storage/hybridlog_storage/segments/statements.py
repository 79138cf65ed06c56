"""Statements of segments on their recording, in metadata records; checked: they may be hostile."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, TypedDict, cast

from msgspec import convert

from hybridlog_storage.errors import SegmentError
from hybridlog_storage.manifest import Count, Nanoseconds, Text, Topic

LossRow = TypedDict(
    "LossRow",
    {
        "cause": Text,
        "reason": Text,
        "file": Text | None,
        "topic": Topic | None,
        "count": Count | None,
        "offset": Count | None,
        "length": Count | None,
        "from": Nanoseconds | None,
        "to": Nanoseconds | None,
    },
)
"""A row of the loss ledger: `from` and `to` are log times, ns; None for what is unknown."""


def loss_rows(value: Mapping[str, object]) -> list[dict[str, Any]]:
    """Rows of the loss ledger, from the value of its metadata record, see `LossRow`."""
    found = value.get("rows")
    try:
        json.dumps(found, ensure_ascii=False).encode()  # fails for halves of surrogate pairs
        rows = cast("list[dict[str, Any]]", convert(found, list[LossRow]))
    except (ValueError, RecursionError) as error:
        raise SegmentError(f"a metadata record is damaged: {error!r}") from error
    for row in rows:
        begin, end = row["from"], row["to"]
        if (begin is None) != (end is None) or (begin is not None and begin > end):
            raise SegmentError("a metadata record is damaged: a loss ends before it begins")
    return rows
