"""Copies many payloads at once from one buffer to another."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import TYPE_CHECKING

import numpy as np

from hybridlog_storage.messages import Batch, Buffer, Left
from hybridlog_storage.ordering import distinct

if TYPE_CHECKING:
    from numpy.typing import NDArray

_SLICE_FROM = 2048  # mean payload bytes from which one slice copy per message is cheapest


def _windows(buffer: Buffer, width: int) -> NDArray[np.void]:
    """A view of every run of `width` bytes of a buffer, by start offset."""
    return np.ndarray(
        (max(len(buffer) - width + 1, 0),), dtype=f"V{width}", buffer=buffer, strides=(1,)
    )


def _copy_payloads(batch: Batch, target: bytearray, starts: NDArray[np.int64]) -> None:
    """Copy each payload of a batch to its position in a large enough buffer."""
    if batch.payload_bytes >= _SLICE_FROM * len(batch):
        # numpy copies between arrays without the interpreter lock.
        source = np.frombuffer(batch.buffer, np.uint8)
        view = np.frombuffer(target, np.uint8)
        for to, at, size in zip(
            starts.tolist(), batch.offset.tolist(), batch.length.tolist(), strict=True
        ):
            view[to : to + size] = source[at : at + size]
        return
    lengths = distinct(batch.length)
    for length in lengths[lengths > 0].tolist():
        rows = slice(None) if len(lengths) == 1 else batch.length == length
        places = _windows(target, length)
        places[starts[rows]] = _windows(batch.buffer, length)[batch.offset[rows]]


def joined(batches: Sequence[Batch]) -> Batch:
    """Join batches, at least one, with whole buffers, over a new one; a single one is unchanged."""
    if len(batches) == 1:
        return batches[0]
    starts = accumulate((len(b.buffer) for b in batches), initial=0)
    return Batch(
        b"".join(b.buffer for b in batches),
        np.concatenate([b.offset + at for b, at in zip(batches, starts, strict=False)]),
        np.concatenate([b.length for b in batches]),
        np.concatenate([b.channel for b in batches]),
        np.concatenate([b.log_time for b in batches]),
        np.concatenate([b.publish_time for b in batches]),
        np.concatenate([b.sequence for b in batches]),
        Left.joined(batches),
    )


def interleave(batches: Sequence[Batch], order: NDArray[np.intp]) -> Batch:
    """Reorder messages over one new buffer: row i is row `order[i]` of the joined batches."""
    length = np.concatenate([b.length for b in batches])[order]
    ends = np.cumsum(length)
    offset = ends - length
    target = bytearray(int(ends[-1]) if len(ends) else 0)
    place = np.empty(len(order), np.int64)
    place[order] = offset
    at = 0
    for batch in batches:
        _copy_payloads(batch, target, place[at : at + len(batch)])
        at += len(batch)
    left = Left.joined(batches)
    return Batch(
        target,
        offset,
        length,
        np.concatenate([b.channel for b in batches])[order],
        np.concatenate([b.log_time for b in batches])[order],
        np.concatenate([b.publish_time for b in batches])[order],
        np.concatenate([b.sequence for b in batches])[order],
        None if left is None else left.take(order),
    )
