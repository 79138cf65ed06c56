"""Decides a predicate on messages that have been read."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import takewhile
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hybridlog.frames.names import is_summary
from hybridlog.query.predicate.to_bool import to_bool
from hybridlog.query.predicate.tree import Predicate
from hybridlog.schema.codec import columns_of, plain_message
from hybridlog_storage.errors import DefinitionError, PayloadError

if TYPE_CHECKING:
    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.query.question import RecordedChannel
    from hybridlog_storage.messages import Batch


class Matches(NamedTuple):
    """The outcome for some messages.

    Attributes:
        holds: bool[n], True where the predicate holds.
        unreadable: Number of messages that the predicate could not test, because they
            do not fit their definition, or lack arrays.
        expired: Number of those that lack arrays, since their payloads are gone.
    """

    holds: NDArray[np.bool_]
    unreadable: int
    expired: int = 0


class MessageFilter:
    """Decides one predicate on decoded messages. Thread safe.

    Args:
        predicate: The condition.
        types: Types of the fields by path; None where no definition fixes them.
    """

    def __init__(self, predicate: Predicate, types: Mapping[str, str] | None) -> None:
        self._predicate = predicate
        self._types = types
        self._test = to_bool(predicate.root, types)
        self._elements = _elements_of(predicate, types or {})
        self._fields = {path.split(".")[0].split("[")[0] for path in predicate.fields()}

    def matches(self, channel: RecordedChannel, batch: Batch, seq: NDArray[np.int64]) -> Matches:
        """Decide on messages of one channel.

        Args:
            channel: Their channel.
            batch: The messages.
            seq: int64[n], their arrival numbers.
        """
        if channel.is_reduced and channel.codec.indexed:
            return self._of_left(channel, batch, seq)
        if not channel.codec.indexed:
            return self._one_by_one(channel, batch, seq, np.arange(len(batch)))
        from hybridlog.query.predicate.to_mask import to_mask

        decoded = columns_of(channel.codec, batch, self._fields - {"_meta"})
        records = decoded.arrow()
        if "_meta" in self._fields:
            good = decoded.rows
            times = batch.log_time[good], seq[good], batch.publish_time[good]
            records = meta_array(records, channel, *times)
        mask = to_mask(self._predicate.root, self._types, records)
        if mask is None:
            return self._one_by_one(channel, batch, seq, np.arange(len(batch)))
        holds = np.zeros(len(batch), np.bool_)
        holds[decoded.rows] = mask
        unreadable = np.setdiff1d(np.arange(len(batch)), decoded.rows, assume_unique=True)
        if len(unreadable):
            rest = self._one_by_one(channel, batch, seq, unreadable)
            holds[unreadable] = rest.holds[unreadable]
            return Matches(holds, rest.unreadable)
        return Matches(holds, 0)

    def _of_left(self, channel: RecordedChannel, batch: Batch, seq: NDArray[np.int64]) -> Matches:
        """Decide on messages without payload; not where an array that is asked for is lacking."""
        from hybridlog.schema.left import LeftFields

        fields = self._elements
        decoded = columns_of(channel.codec, batch, fields)
        assert isinstance(decoded.records, LeftFields)
        lacking = decoded.rows[decoded.records.lacking()] if fields else decoded.rows[:0]
        decidable = np.setdiff1d(np.arange(len(batch)), lacking, assume_unique=True)
        known = dict(zip(decoded.rows.tolist(), decoded.plain(), strict=True))
        found = self._one_by_one(channel, batch, seq, decidable, known)
        return Matches(found.holds, found.unreadable + len(lacking), len(lacking))

    def _one_by_one(
        self,
        channel: RecordedChannel,
        batch: Batch,
        seq: NDArray[np.int64],
        rows: NDArray[np.intp],
        known: Mapping[int, dict[str, Any]] | None = None,
    ) -> Matches:
        """Decide on some rows, whose fields may be known by row."""
        holds = np.zeros(len(batch), np.bool_)
        unreadable = 0
        for row in rows.tolist():
            try:
                if known is None:
                    fields = plain_message(channel.codec, batch.payload(row), self._fields)
                else:
                    fields = known[row]
            except (PayloadError, DefinitionError, KeyError):
                if self._fields != {"_meta"}:
                    unreadable += 1
                    continue
                fields = {}
            if "_meta" in self._fields:
                fields["_meta"] = _meta_of(channel, batch, seq, row)
            holds[row] = self._test(fields)
        return Matches(holds, unreadable)


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


def _meta_of(
    channel: RecordedChannel, batch: Batch, seq: NDArray[np.int64], row: int
) -> dict[str, Any]:
    meta: dict[str, Any] = {
        "t": int(batch.log_time[row]),
        "rec": channel.recording.key,
        "topic": channel.channel.topic,
        "seq": int(seq[row]),
    }
    if channel.channel.has_publish_time:
        meta["pub"] = int(batch.publish_time[row])
    return meta


def meta_array(
    records: pa.StructArray,
    channel: RecordedChannel,
    log_time: NDArray[np.int64],
    seq: NDArray[np.int64],
    publish_time: pa.Array[Any] | NDArray[np.int64] | None,
) -> pa.StructArray:
    """The records with a field `_meta` of the values that a message itself provides.

    Args:
        records: n rows.
        channel: The channel of the messages.
        log_time: int64[n], ns.
        seq: int64[n], arrival numbers.
        publish_time: int64[n], ns; None when unknown.
    """
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
