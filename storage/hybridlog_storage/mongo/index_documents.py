"""Index documents as bytes around the fields of messages; which recordings a database has.

A document is `_id`, the message's fields, and `_meta` (see `docs/derived.md`). The fields
are given as BSON elements. Thousands of documents are assembled at once: a template row is
tiled, and each value that differs is a column.
"""

from __future__ import annotations

import hashlib
import re
import secrets
import struct
from collections.abc import Collection, Mapping
from datetime import UTC, datetime
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from hybridlog_storage.errors import DatabaseError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.messages import Channel
    from hybridlog_storage.mongo.database import Database
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
        self._tail = _Tail(key, channel, None)

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
        tail = self._tail if error is None else _Tail(self._key, self._channel, error)
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


CATALOG_PREFIX = "hybridlog."
"""Catalog collections start with this; no topic's collection has a dot in its name."""

_CANONICAL = re.compile(r"(?:/[A-Za-z0-9]+(?:_[A-Za-z0-9]+)*)+")
_ODD = re.compile(r"[^A-Za-z0-9_]")
_LONGEST = 120  # a MongoDB namespace (database.collection) has at most 255 bytes


@lru_cache(maxsize=4096)
def collection_of(topic: str) -> str:
    """The collection that holds the index documents of a topic.

    `r_gripper_controller__command` for `/r_gripper_controller/command`; for a topic that is not a
    canonical ROS name, a readable form, `~` and eight hex digits.
    """
    if _CANONICAL.fullmatch(topic) and len(topic) <= _LONGEST:
        return topic[1:].replace("/", "__")
    digest = hashlib.sha256(topic.encode("utf-8", "surrogatepass")).hexdigest()[:8]
    readable = _ODD.sub("_", topic.removeprefix("/").replace("/", "__"))[:100]
    return f"{readable}~{digest}"


RECORDINGS: Final = f"{CATALOG_PREFIX}recordings"
STORE: Final = f"{CATALOG_PREFIX}store"
"""Collection that names the store that owns a database."""
_AROUND_NS: Final = 3600 * 10**9  # what a crash has cut may be so far from the rest


class Owner(NamedTuple):
    """The owner of a database: a store, its host and path, and the id of the index.

    A copy of the store at another place has the same id.
    """

    store: str
    place: str
    made: str


def other_store(database: Database) -> DatabaseError:
    """The error for a database that another store owns."""
    return DatabaseError(
        f"The database {database.name!r} at {database.address} holds the index of another store. "
        "Name a database of its own in the URI: mongodb://host/NAME."
    )


class IndexState:
    """The recordings indexed in a database."""

    def __init__(self, database: Database) -> None:
        self._db = database

    def of(self, keys: Collection[str] | None = None) -> dict[str, dict[str, str]]:
        """Digests of completely indexed segments of these recordings, or of all, by key.

        They are by their numbers as text. Of a recording whose documents are all there, they are
        those of its entry.
        """
        chosen: dict[str, object] = {} if keys is None else {"_id": {"$in": sorted(keys)}}
        return {
            found["_id"]: dict(found.get("segments") or {})
            for found in self._db.find(RECORDINGS, chosen)
        }

    def count(self) -> int:
        """Number of recordings; may be wrong after the server was killed."""
        return self._db.count(RECORDINGS)

    def begin(self, entry: RecordingEntry, segments: Mapping[str, str] | None = None) -> None:
        """Note that documents of a recording are about to be made, or removed.

        `segments` has the digest of each segment whose documents stay, by its number as text.
        """
        state = {"id": entry.id, "segments": dict(segments or {})}
        self._db.update(RECORDINGS, {"_id": entry.key}, {"$set": state}, upsert=True)

    def put_segments(self, key: str, segments: Mapping[str, str]) -> None:
        """Note that all documents of some segments are there: their digests, by number as text."""
        digests = {f"segments.{number}": digest for number, digest in segments.items()}
        self._db.update(RECORDINGS, {"_id": key}, {"$set": digests})

    def clear(self, entry: RecordingEntry, but: Collection[str] = ()) -> None:
        """Remove the index documents of a recording, but those of some segments, numbers as text.

        A crash may have cut messages whose documents are here. So these are looked for up to an
        hour around its messages and losses, and in all topics unless the recording is complete.
        """
        chosen: dict[str, object] = {"_meta.rec": entry.key}
        lost = (row[one] for row in entry.losses for one in ("from", "to"))
        times: list[Any] = [*(entry.span or ()), *lost]
        if times and None not in times:
            chosen.update(between(max(0, min(times) - _AROUND_NS), max(times) + _AROUND_NS))
        if but:
            chosen["_meta.ref.seg"] = {"$nin": sorted(map(int, but))}
        collections = {collection_of(channel.topic) for channel in entry.channels}
        if entry.status != "complete":
            collections |= {*self.document_collections()}
        for collection in collections:
            self._db.delete(collection, chosen)

    def forget(self, keys: Collection[str]) -> None:
        """Remove recordings and all their documents, looking through everything."""
        for collection in self.document_collections():
            self._db.delete(collection, {"_meta.rec": {"$in": list(keys)}})
        self.remove(keys)

    def clear_all(self, but: Collection[str]) -> None:
        """Remove all recordings and their documents but some, which are given by their keys."""
        self._db.delete(RECORDINGS, {"_id": {"$nin": list(but)}})
        for collection in self.document_collections():
            self._db.delete(collection, {"_meta.rec": {"$nin": list(but)}})

    def remove(self, keys: Collection[str]) -> None:
        """Remove the states of recordings, as the last step of their removal."""
        self._db.delete(RECORDINGS, {"_id": {"$in": list(keys)}})

    def document_collections(self) -> list[str]:
        """Names of the collections that hold index documents."""
        return [c for c in self._db.list_collections() if not c.startswith(CATALOG_PREFIX)]

    def owner(self) -> Owner | None:
        """The store that owns the database; None without an owner."""
        for found in self._db.find(STORE, {"_id": "store"}):
            return Owner(*(str(found.get(name, "")) for name in Owner._fields))
        return None

    def claim(self, store: str, place: str) -> Owner:
        """Register the store that owns the database.

        The index gets a new id, so that nothing is believed of it that was known before.
        """
        owner = Owner(store, place, secrets.token_hex(8))
        self._db.update(STORE, {"_id": "store"}, {"$set": owner._asdict()}, upsert=True)
        return owner
