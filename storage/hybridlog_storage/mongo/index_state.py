"""Stores in MongoDB which segments of each recording are indexed.

Reads see only what a majority of a replica set has, so the documents, written before, cannot be
lost.
"""

from __future__ import annotations

import secrets
from collections.abc import Collection, Mapping
from typing import Final, NamedTuple

from hybridlog_storage.catalog import RecordingEntry
from hybridlog_storage.errors import DatabaseError
from hybridlog_storage.mongo.collection_names import CATALOG_PREFIX, collection_of
from hybridlog_storage.mongo.database import Database
from hybridlog_storage.mongo.index_documents import between

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
        rows = entry.end.get("losses", ())
        times = [*(entry.span or (None,)), *(row[one] for row in rows for one in ("from", "to"))]
        known = [time for time in times if time is not None]
        if len(known) == len(times):
            chosen.update(between(max(0, min(known) - _AROUND_NS), max(known) + _AROUND_NS))
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
