"""Whole messages as plain objects: dict, list, str, bool, int, float, None."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import numpy as np

from hybridlog.schema.codec import codec_for
from hybridlog.schema.column import Column, Records, Scalars, Strings
from hybridlog.schema.document import top_level_names
from hybridlog_storage.errors import PayloadError

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from hybridlog_storage.messages import Buffer, Channel

_ALL = 1 << 31  # elements: no array is summarised
_DEFINED = {"ros1", "cdr"}


def plain_message(
    channel: Channel, payload: Buffer, names: Collection[str]
) -> Mapping[str, object]:
    """A message with its arrays whole; empty when it cannot be read.

    Args:
        channel: Its channel.
        payload: The serialized message.
        names: Fields of the top level that are needed, at least.
    """
    if channel.message_encoding == "json":
        return _of_json(channel, payload)
    if channel.message_encoding not in _DEFINED or not names:
        return codec_for(channel, array_limit=_ALL).fields(payload)
    codec = codec_for(channel)
    if not codec.indexed:
        return {}
    size = np.array([memoryview(payload).nbytes], np.int64)
    decoded = codec.columns(payload, np.zeros(1, np.int64), size, None)
    if not len(decoded.rows):
        return {}
    columns = decoded.records.fields
    spelled = zip(top_level_names(columns), columns.values(), strict=True)
    return {name: _rows(column)[0] for name, column in spelled if name in names}


def _of_json(channel: Channel, payload: Buffer) -> Mapping[str, object]:
    try:
        value = codec_for(channel).decode(payload)
    except PayloadError:
        return {}
    if not isinstance(value, dict):
        return {"value": value}
    return dict(zip(top_level_names(value), value.values(), strict=True))


def _rows(column: Column) -> list[Any]:
    """The value of each row."""
    if isinstance(column, Scalars):
        numbers: list[Any] = column.values.tolist()
        return numbers
    if isinstance(column, Records):
        values = [_rows(inner) for inner in column.fields.values()]
        return [
            dict(zip(column.fields, each, strict=True)) for each in zip(*values, strict=True)
        ] or [{} for _ in range(len(column))]
    ends = column.offset.tolist()
    pairs = itertools.pairwise(ends)
    if isinstance(column, Strings):
        text = column.data.tobytes()
        first = ends[0]
        return [text[low - first : high - first].decode(errors="replace") for low, high in pairs]
    inner = _rows(column.values)
    return [inner[low:high] for low, high in pairs]
