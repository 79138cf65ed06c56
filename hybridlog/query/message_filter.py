"""Decides a predicate on messages that have been read."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hybridlog.query.predicate.evaluate import on_columns, on_objects
from hybridlog.query.predicate.tree import is_meta
from hybridlog.schema.arrow_columns import structs

if TYPE_CHECKING:
    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.query.predicate.evaluate import Verdict
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
        return Matches(verdict_of(part, channel, structs({}, len(batch)), *times).holds, 0)
    if not channel.codec.indexed:
        return Matches(holds, len(batch))
    decoded = channel.codec.columns_of(batch, fields)
    rows, left = decoded.rows, channel.is_reduced
    times = batch.log_time[rows], seq[rows], batch.publish_time[rows]
    found = None if left else verdict_of(part, channel, decoded.arrow(), *times)
    if found is None or found.open.any():
        plain = decoded.plain(whole=False)
        if any(map(is_meta, predicate.fields())):
            meta = meta_array(structs({}, len(rows)), channel, *times).to_pylist()
            plain = [{**one, **own} for one, own in zip(plain, meta, strict=True)]
        found = on_objects(predicate, types, plain, left=left)
    holds[rows] = found.holds
    lacking = int(found.open.sum())
    return Matches(holds, len(batch) - len(rows) + lacking, lacking)


def verdict_of(
    part: Part, channel: RecordedChannel, records: pa.StructArray, *times: Any
) -> Verdict:
    """The outcome of a part's predicate on columns.

    `times` are log times, arrival numbers and publish times, as of `meta_array`.
    """
    assert part.predicate is not None
    if any(map(is_meta, part.predicate.fields())):
        records = meta_array(records, channel, *times)
    return on_columns(part.predicate, part.field_types, records)


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
