"""Assembles index documents as bytes around the fields of messages.

A document is `_id`, the message's fields, and `_meta` (see `docs/format.md`). The fields
are given as BSON elements. Thousands of documents are assembled at once: a template row is
tiled, and each value that differs is a column.
"""

from __future__ import annotations

import struct
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog_storage.messages import Channel
    from hybridlog_storage.segments.chunk import Placed

KEY_BYTES: Final = 24
_HEAD_WIDTH: Final = 4 + 1 + 4 + 4 + 1 + KEY_BYTES
_KEY_AT: Final = _HEAD_WIDTH - KEY_BYTES
_HEAD: Final = b"\x05_id\x00" + struct.pack("<iB", KEY_BYTES, 0)  # behind the length
_MAX_TIME: Final = (1 << 63) - 1


def key_bound(log_time: int) -> bytes:
    """The smallest key (`_id`) of any message at or after a log time in nanoseconds."""
    return struct.pack(">QQQ", min(max(log_time, 0), _MAX_TIME + 1), 0, 0)


def between(begin: int | None = None, end: int | None = None) -> dict[str, object]:
    """A filter for documents with log times in `[begin, end)`, ns; None for no bound."""
    if begin is None and end is None:
        return {}
    until = {} if end is None else {"$lt": key_bound(end)}
    return {"_id": {"$gte": key_bound(begin or 0), **until}}


class DocumentAssembler:
    """Assembles the index documents of one channel of one recording.

    `key` is the last 16 hexadecimal digits of the recording's id.
    """

    def __init__(self, key: str, channel: Channel) -> None:
        self._key = key
        self._channel = channel
        self._tails: dict[str | None, _Tail] = {}

    def assemble(
        self,
        placed: Placed,
        rows: NDArray[np.intp],
        body: NDArray[np.uint8],
        error: str | None = None,
    ) -> NDArray[np.uint8]:
        """Assemble documents: uint8[k, width], a whole BSON document a row.

        `rows` is intp[k]; `body` is uint8[k, w], the BSON elements of each message's fields.
        `error` is the reason for missing ones, for `_meta.error`.
        """
        tail = self._tails.get(error)
        if tail is None:
            if len(self._tails) > 256:
                self._tails.clear()
            tail = self._tails[error] = _Tail(self._key, self._channel, error)
        count, fields = body.shape
        width = _HEAD_WIDTH + fields + len(tail.template)
        out = np.empty((count, width), np.uint8)
        out[:, :_KEY_AT] = np.frombuffer(struct.pack("<i", width) + _HEAD, np.uint8)
        batch = placed.batch
        log_time = batch.log_time[rows]
        seq = placed.seq[rows]
        _column(out, _KEY_AT, ">i8")[:] = log_time
        _column(out, _KEY_AT + 8, ">u8")[:] = int(self._key, 16)
        _column(out, _KEY_AT + 16, ">i8")[:] = seq
        out[:, _HEAD_WIDTH : _HEAD_WIDTH + fields] = body
        start = _HEAD_WIDTH + fields
        out[:, start:] = tail.template
        at = tail.at
        _column(out, start + at["inserted_at"], "<i8")[:] = log_time // 1_000_000
        _column(out, start + at["t"], "<i8")[:] = log_time
        if "pub" in at:
            _column(out, start + at["pub"], "<i8")[:] = batch.publish_time[rows]
        _column(out, start + at["seq"], "<i8")[:] = seq
        _column(out, start + at["seg"], "<i4")[:] = placed.segment[rows]
        _column(out, start + at["chunk"], "<i8")[:] = placed.chunk[rows]
        _column(out, start + at["off"], "<i8")[:] = placed.offset[rows]
        _column(out, start + at["len"], "<i8")[:] = placed.length[rows]
        return out


class _Tail:
    """The `_meta` element and the document's end, and the positions of their values."""

    def __init__(self, key: str, channel: Channel, error: str | None) -> None:
        from bson import Int64, encode

        topic, said = (text.encode("utf-8", "replace") for text in (channel.topic, error or ""))
        times = ("t", "pub") if channel.has_publish_time else ("t",)
        meta = {
            "inserted_at": datetime.fromtimestamp(0, UTC),
            **dict.fromkeys(times, Int64(0)),
            "rec": key,
            "topic": topic.decode(),
            "seq": Int64(0),
            "ref": {"seg": 0, **dict.fromkeys(("chunk", "off", "len"), Int64(0))},
            **({} if error is None else {"error": said[:1000].decode(errors="ignore")}),
        }
        data = encode({"_meta": meta})[4:]
        self.template = np.frombuffer(data, np.uint8)
        self.at: dict[str, int] = {}
        at = 0
        for name in ("inserted_at", *times, "topic", "seq", "ref", "seg", "chunk", "off", "len"):
            at = self.at[name] = data.index(b"%s\0" % name.encode(), at) + len(name) + 1
            if name == "topic":  # whatever its name contains
                at += 4 + len(topic)


def _column(out: NDArray[np.uint8], offset: int, dtype: str) -> NDArray[np.int64]:
    """A column view of one value at a fixed position in each row."""
    return np.ndarray((len(out),), dtype, buffer=out, offset=offset, strides=(out.shape[1],))
