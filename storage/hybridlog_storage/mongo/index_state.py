"""Stores in MongoDB the indexing progress of each recording.

`hybridlog.recordings` mirrors the catalog for other programs. It also states for each
recording which segments have all their documents. Reads see only what a majority of a replica
set has, so the documents, written before, cannot be lost.
"""

from __future__ import annotations

import secrets
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, Final

from hybridlog_storage.catalog import RecordingEntry
from hybridlog_storage.mongo.collection_names import CATALOG_PREFIX, collection_of
from hybridlog_storage.mongo.database import Database
from hybridlog_storage.mongo.index_documents import between

RECORDINGS: Final = f"{CATALOG_PREFIX}recordings"
STORE: Final = f"{CATALOG_PREFIX}store"
"""Collection that names the store that owns a database."""
_AROUND_NS: Final = 3600 * 10**9  # what a crash has cut may be so far from the rest
_CHANNEL_BYTES: Final = 600  # of a channel in the mirror, without its texts
_MAX_CHANNEL_BYTES: Final = 8 << 20  # of all: a document of MongoDB has at most 16 MiB
_SHOWN: Final = (
    "name",
    "tags",
    "status",
    "notes",
    "marks",
    "pins",
    "rows",
    "stored_bytes",
)
"""Values of an entry that may change while its segments stay."""


@dataclass(frozen=True, slots=True)
class Indexed:
    """The state of a recording's index.

    Attributes:
        made: Drawn at random when the documents were begun. Who reads the same before and after
            a question knows that none were removed meanwhile.
        segments: Digest of each completely indexed segment, by its number as text.
        shown: Name, tags, notes and marks in the mirror.
    """

    made: str
    segments: Mapping[str, str]
    shown: Mapping[str, Any] = field(default_factory=dict)

    def mirrors(self, entry: RecordingEntry) -> bool:
        """True if the mirror of a recording with the same segments is current."""
        document = _mirrored(entry)
        return all(self.shown.get(name) == document[name] for name in _SHOWN)

    def is_whole(self, entry: RecordingEntry) -> bool:
        """True if all documents of a recording are there."""
        return dict(self.segments) == entry.digests


class IndexState:
    """The recordings indexed in a database."""

    def __init__(self, database: Database) -> None:
        self._db = database

    def one(self, key: str) -> Indexed | None:
        """The index state of a recording by its key; None if it is unknown."""
        return self.of([key]).get(key)

    def of(
        self, keys: Collection[str] | None = None, shown: Collection[str] = _SHOWN
    ) -> dict[str, Indexed]:
        """The index states of these recordings, or of all, by key; `shown` are read, too."""
        chosen: dict[str, object] = {} if keys is None else {"_id": {"$in": sorted(keys)}}
        found: dict[str, Indexed] = {}
        for document in self._db.find(RECORDINGS, chosen, dict.fromkeys(("index", *shown), 1)):
            index = document.get("index") or {}
            found[document["_id"]] = Indexed(
                str(index.get("made", "")),
                dict(index.get("segments") or {}),
                {name: document.get(name) for name in shown},
            )
        return found

    def count(self) -> int:
        """Number of recordings in the mirror; may be wrong after the server was killed."""
        return self._db.count(RECORDINGS)

    def begin(self, entry: RecordingEntry, segments: Mapping[str, str] | None = None) -> None:
        """Note that documents of a recording are about to be made, or removed.

        A mirror that is there stays until the end: it says which documents may be there.

        Args:
            entry: The recording.
            segments: Digest of each segment whose documents stay, by its number as text.
        """
        index = {"made": secrets.token_hex(8), "segments": dict(segments or {})}
        change = {"$set": {"index": index}, "$setOnInsert": _mirrored(entry)}
        self._db.update(RECORDINGS, {"_id": entry.key}, change, upsert=True)

    def show(self, entry: RecordingEntry) -> None:
        """Mirror a recording; leave the state of its index unchanged."""
        self._db.update(RECORDINGS, {"_id": entry.key}, {"$set": _mirrored(entry)})

    def end(self, entry: RecordingEntry) -> None:
        """Mirror a recording all of whose documents are in the index."""
        done = {**_mirrored(entry), "index.segments": entry.digests}
        self._db.update(RECORDINGS, {"_id": entry.key}, {"$set": done})

    def put_segments(self, key: str, segments: Mapping[str, str]) -> None:
        """Store that the index of a recording has all documents of some segments.

        Args:
            key: Its key.
            segments: Their digests, by number as text.
        """
        digests = {f"index.segments.{number}": digest for number, digest in segments.items()}
        self._db.update(RECORDINGS, {"_id": key}, {"$set": digests})

    def clear(self, entry: RecordingEntry, but: Collection[str] = ()) -> None:
        """Remove the index documents of a recording.

        They are looked for in its topics, within its times and an hour around them: a crash may
        have cut messages whose documents are here.

        Args:
            entry: The recording.
            but: Numbers of the segments whose documents stay, as text.
        """
        topics = {channel.topic for channel in entry.channels}
        times = [*(entry.span or ())]
        mirror = self._db.find_one(RECORDINGS, {"_id": entry.key}, {"channels": 1}) or {}
        for channel in mirror.get("channels") or ():
            stats = channel.get("stats") or {}
            topics.add(str(channel.get("topic", "")))
            times += [at for name in ("first", "last") if (at := stats.get(name)) is not None]
        chosen: dict[str, object] = {"_meta.rec": entry.key}
        if times:
            chosen.update(between(max(0, min(times) - _AROUND_NS), max(times) + _AROUND_NS))
        if but:
            chosen["_meta.ref.seg"] = {"$nin": sorted(map(int, but))}
        for topic in topics:
            self._db.delete(collection_of(topic), chosen)

    def clear_everywhere(self, keys: Collection[object]) -> None:
        """Remove all documents of recordings, looking through everything.

        Args:
            keys: Their keys, or other values of `_meta.rec` in foreign documents.
        """
        for collection in self.document_collections():
            self._db.delete(collection, {"_meta.rec": {"$in": list(keys)}})

    def clear_all(self, but: Collection[str]) -> None:
        """Remove all recordings and their documents but some, which are given by their keys."""
        self._db.delete(RECORDINGS, {"_id": {"$nin": list(but)}})
        for collection in self.document_collections():
            self._db.delete(collection, {"_meta.rec": {"$nin": list(but)}})

    def remove(self, keys: Collection[str]) -> None:
        """Remove recordings from the mirror, as the last step of their removal."""
        self._db.delete(RECORDINGS, {"_id": {"$in": list(keys)}})

    def document_collections(self) -> list[str]:
        """Names of the collections that hold index documents."""
        return [c for c in self._db.list_collections() if not c.startswith(CATALOG_PREFIX)]

    def mark(self) -> Mapping[str, Any] | None:
        """The store that owns the database, and its place; None without an owner."""
        return self._db.find_one(STORE, {"_id": "store"})

    def claim(self, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Register the store that owns the database; return its mark.

        The index gets a new id, so that nothing is believed of it that was known before.
        """
        mark = {"_id": "store", **values, "index": secrets.token_hex(8)}
        self._db.replace(STORE, {"_id": "store"}, mark)
        return mark


def _mirrored(entry: RecordingEntry) -> dict[str, Any]:
    """An entry as MongoDB accepts it."""
    document = entry.to_document()
    del document["held"]
    text = (
        len(part)
        for channel in entry.channels
        for part in (channel.topic, channel.reason or "", *chain(*channel.metadata.items()))
    )
    if len(entry.channels) * _CHANNEL_BYTES + sum(text) > _MAX_CHANNEL_BYTES:
        document["channels"] = [{"topic": channel.topic} for channel in entry.channels]
    return document
