"""Decides a predicate on messages that have been read."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import takewhile
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hybridlog.frames.names import is_summary
from hybridlog.query.predicate.to_mask import mask_of_objects, to_mask
from hybridlog.query.predicate.tree import Predicate, is_meta
from hybridlog.schema.arrow_columns import structs

if TYPE_CHECKING:
    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.query.question import Part, RecordedChannel
    from hybridlog_storage.messages import Batch


class Matches(NamedTuple):
    """The outcome for some messages.

    Attributes:
        holds: bool[n], true where the predicate holds.
        unreadable: Number of messages that the predicate could not test, because they do not fit
            their definition, or lack arrays.
        expired: Number of those that lack arrays, since their payloads are gone.
    """

    holds: NDArray[np.bool_]
    unreadable: int
    expired: int = 0


def matches(part: Part, channel: RecordedChannel, batch: Batch, seq: NDArray[np.int64]) -> Matches:
    """Decide the predicate of a part on messages of one of its channels; `seq` as they arrived."""
    predicate, types = part.predicate, part.field_types
    assert predicate is not None
    holds = np.zeros(len(batch), np.bool_)
    fields = {path.split(".")[0].split("[")[0] for path in predicate.fields()} - {"_meta"}
    times = batch.log_time, seq, batch.publish_time
    if not fields:  # what a message itself provides can be asked of any
        mask = mask_of(part, channel, structs({}, len(batch)), *times)
        assert mask is not None
        return Matches(mask, 0)
    if not channel.codec.indexed:
        return Matches(holds, len(batch))
    if channel.is_reduced:
        fields = _elements_of(predicate, types or {})
    decoded = channel.codec.columns_of(batch, fields)
    rows = decoded.rows
    times = batch.log_time[rows], seq[rows], batch.publish_time[rows]
    lacking = np.zeros(len(rows), np.bool_)
    if channel.is_reduced:
        from hybridlog.schema.left import LeftFields

        assert isinstance(decoded.records, LeftFields)
        lacking = decoded.records.lacking() if fields else lacking
        mask = None  # of some arrays only summaries are left
    else:
        mask = mask_of(part, channel, decoded.arrow(), *times)
    if mask is None:
        plain = decoded.plain(whole=False)
        if any(map(is_meta, predicate.fields())):
            meta = meta_array(structs({}, len(rows)), channel, *times).to_pylist()
            plain = [{**one, **own} for one, own in zip(plain, meta, strict=True)]
        mask = mask_of_objects(predicate, types, plain)
    holds[rows] = mask & ~lacking
    unread, expired = len(batch) - len(rows), int(lacking.sum())
    return Matches(holds, unread + expired, expired)


def mask_of(
    part: Part, channel: RecordedChannel, records: pa.StructArray, *times: Any
) -> NDArray[np.bool_] | None:
    """Mask of the messages for which a part's predicate holds; None if columns cannot decide.

    `times` are log times, arrival numbers and publish times, as of `meta_array`.
    """
    assert part.predicate is not None
    if any(map(is_meta, part.predicate.fields())):
        records = meta_array(records, channel, *times)
    return to_mask(part.predicate, part.field_types, records)


def _elements_of(predicate: Predicate, types: Mapping[str, str]) -> set[str]:
    """Fields in a predicate, but for summaries of arrays that are in no other array."""
    found = set()
    for condition in predicate.conditions():
        parts = condition.field.parts
        path = condition.field.path
        is_plain = all(isinstance(part, str) for part in parts) and is_summary(path, types)
        if not is_plain or path.rpartition(".")[0] not in types:
            names = takewhile(lambda part: isinstance(part, str), parts)
            found.add(".".join(map(str, names)))
    return found - {"_meta"}


def meta_array(
    records: pa.StructArray,
    channel: RecordedChannel,
    log_time: NDArray[np.int64],
    seq: NDArray[np.int64],
    publish_time: pa.Array[Any] | NDArray[np.int64] | None,
) -> pa.StructArray:
    """The records with a field `_meta` of what a message itself provides; times in ns."""
    import pyarrow as pa

    rows = len(log_time)
    columns: dict[str, Any] = {
        "t": pa.array(log_time),
        "rec": pa.array([channel.recording.key] * rows, pa.string()),
        "topic": pa.array([channel.channel.topic] * rows, pa.string()),
        "seq": pa.array(seq),
    }
    if channel.channel.has_publish_time and publish_time is not None:
        columns["pub"] = pa.array(publish_time)
    meta = pa.StructArray.from_arrays(list(columns.values()), names=list(columns))
    names = [field.name for field in records.type]
    return pa.StructArray.from_arrays([*records.flatten(), meta], names=[*names, "_meta"])
