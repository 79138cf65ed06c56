"""Stores in MongoDB the indexing progress of each recording.

`hybridlog.recordings` mirrors the catalog for other programs. It also states for each
recording whether its index is complete, and from which segments it was made. The index is
used only if both match, and in a replica set only if a majority of its members has them:
then the documents, written before, cannot be lost. A segment is noted after its documents, so
a killed server has not lost any of them.
"""

from __future__ import annotations

import secrets
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, Final, Literal

from hybridlog_storage.catalog import RecordingEntry
from hybridlog_storage.mongo.collection_names import CATALOG_PREFIX, collection_of
from hybridlog_storage.mongo.database import Database
from hybridlog_storage.mongo.index_documents import between

RECORDINGS: Final = f"{CATALOG_PREFIX}recordings"
STORE: Final = f"{CATALOG_PREFIX}store"
"""Collection that names the store that owns a database."""
_ENTRIES_PER_BATCH: Final = (
    500  # entries decoded at once; each takes some kilobytes as a dictionary
)

State = Literal["open", "clearing", "indexing", "complete", "removing"]
"""State of a recording's index: being recorded, documents being removed for a rebuild, being
indexed, complete, being removed for good."""
_CHANNEL_BYTES: Final = 600  # of a channel in the mirror, without its texts
_MAX_CHANNEL_BYTES: Final = 8 << 20  # of all: a document of MongoDB has at most 16 MiB
_OF_CHANNELS: Final = ("channels.topic", "channels.stats.first", "channels.stats.last")
_MAX_NAMES: Final = (
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
        id: The recording.
        state: Progress of the index.
        segments: Digest of each completely indexed segment, by its number as text.
        turn: Counts how often its documents were removed or rebuilt.
        topics: Topics of its documents, as far as known.
        span: First and last log time of its documents, ns, as far as known; None without any.
        shown: Name, tags, notes and marks in the mirror.
        damage: Chunks that could not be read for indexing: reason by segment and number.
    """

    id: str
    state: State
    segments: Mapping[str, str]
    turn: int
    topics: tuple[str, ...] = ()
    span: tuple[int, int] | None = None
    shown: Mapping[str, Any] = field(default_factory=dict)
    damage: Mapping[tuple[int, int], str] = field(default_factory=dict)

    def mirrors(self, entry: RecordingEntry) -> bool:
        """True if the mirror of a recording with the same segments is current."""
        document = _mirrored(entry)
        return all(self.shown.get(name) == document[name] for name in _MAX_NAMES)

    def is_whole(self, entry: RecordingEntry) -> bool:
        """True if the index of a recording is complete and current."""
        return self.state == "complete" and dict(self.segments) == entry.digests


class IndexState:
    """The recordings indexed in a database."""

    def __init__(self, database: Database) -> None:
        self._db = database

    def one(self, key: str) -> Indexed | None:
        """The index state of a recording by its key; None if it is unknown."""
        return self.of([key]).get(key)

    def of(self, keys: Collection[str] | None = None) -> dict[str, Indexed]:
        """The index states of these recordings, or of all, by key."""
        chosen: dict[str, object] = {} if keys is None else {"_id": {"$in": sorted(keys)}}
        found: dict[str, Indexed] = {}
        wanted = {"id": 1, "index": 1, **dict.fromkeys((*_OF_CHANNELS, *_MAX_NAMES), 1)}
        for document in self._db.find(
            RECORDINGS, chosen, wanted, batch_size=_ENTRIES_PER_BATCH, read="majority"
        ):
            index = document.get("index") or {}
            channels = document.get("channels") or ()
            topics = {str(channel.get("topic", "")) for channel in channels}
            firsts, lasts = (
                [t for c in channels if (t := (c.get("stats") or {}).get(name)) is not None]
                for name in ("first", "last")
            )
            found[document["_id"]] = Indexed(
                str(document.get("id", "")),
                index.get("state", "indexing"),
                dict(index.get("segments") or {}),
                int(index.get("turn", 0)),
                tuple(sorted(topics)),
                (min(firsts), max(lasts)) if firsts and lasts else None,
                {name: document.get(name) for name in _MAX_NAMES},
                {(d["seg"], d["chunk"]): d["reason"] for d in index.get("damage") or ()},
            )
        return found

    def count(self) -> int:
        """Number of recordings in the mirror; may be wrong after the server was killed."""
        return self._db.stats(RECORDINGS).documents

    def segments(self, keys: Collection[str]) -> dict[str, tuple[int, dict[str, str]]]:
        """Turn, and digests of the indexed segments, of recordings by key, without unknown ones.

        Who reads the same before and after a question has been told of all removals meanwhile.
        """
        chosen, wanted = {"_id": {"$in": sorted(keys)}}, {"index.turn": 1, "index.segments": 1}
        found = self._db.find(RECORDINGS, chosen, wanted, read="majority")
        indexed = ((one["_id"], one.get("index") or {}) for one in found)
        return {
            key: (int(index.get("turn", 0)), dict(index.get("segments") or {}))
            for key, index in indexed
        }

    def put(
        self,
        entry: RecordingEntry,
        state: State,
        *,
        turn: int,
        segments: Mapping[str, str] | None = None,
        damage: Mapping[tuple[int, int], str] | None = None,
    ) -> None:
        """Mirror a recording and store the progress of its index.

        Args:
            entry: The recording.
            state: Progress of the index.
            turn: Greater than before if documents are about to be removed.
            segments: Digest of each indexed segment, by its number as text.
            damage: Chunks that could not be read: reason by segment and number.
        """
        unreadable = [
            {"seg": segment, "chunk": chunk, "reason": reason}
            for (segment, chunk), reason in sorted((damage or {}).items())
        ]
        document = {
            **_mirrored(entry),
            "_id": entry.key,
            "index": {
                "state": state,
                "turn": turn,
                "segments": dict(segments or {}),
                **({"damage": unreadable} if unreadable else {}),
            },
        }
        self._db.replace(RECORDINGS, {"_id": entry.key}, document)

    def show(self, entry: RecordingEntry) -> None:
        """Mirror a recording; leave the state of its index unchanged."""
        self._db.update(RECORDINGS, {"_id": entry.key}, {"$set": _mirrored(entry)})

    def is_mirrored(self, entry: RecordingEntry) -> bool:
        """True if the mirror of a recording equals its catalog entry."""
        found = self._db.find_one(RECORDINGS, {"_id": entry.key})
        if found is None:
            return False
        document = {name: found[name] for name in found if name not in {"_id", "index"}}
        return document == _mirrored(entry)

    def put_segments(self, key: str, segments: Mapping[str, str]) -> None:
        """Store that the index of a recording has all documents of some segments.

        Args:
            key: Its key.
            segments: Their digests, by number as text.
        """
        digests = {f"index.segments.{number}": digest for number, digest in segments.items()}
        self._db.update(RECORDINGS, {"_id": key}, {"$set": digests})

    def clear(
        self,
        key: object,
        topics: Iterable[str] | None = None,
        span: tuple[int, int] | None = None,
        but: Collection[int] = (),
    ) -> None:
        """Remove the index documents of a recording.

        Args:
            key: Key of the recording, or another value of `_meta.rec` in foreign documents.
            topics: Those that may have documents; None for all documents, which takes a scan.
            span: First and last log time of its documents of these topics, ns; None for any.
            but: Segments whose documents stay.
        """
        chosen: dict[str, object] = {"_meta.rec": key}
        if but:
            chosen["_meta.ref.seg"] = {"$nin": sorted(but)}
        if topics is None:
            for collection in self.document_collections():
                self._db.delete(collection, chosen)
            return
        bounds = (None, None) if span is None else (span[0], span[1] + 1)
        for topic in topics:
            self._db.delete(collection_of(topic), {**chosen, **between(*bounds)})

    def remove(self, key: str) -> None:
        """Remove a recording from the mirror, as the last step of its removal."""
        self._db.delete(RECORDINGS, {"_id": key})

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
