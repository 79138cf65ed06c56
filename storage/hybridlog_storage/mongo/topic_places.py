"""Places of index documents: the collection of MongoDB that holds those of a topic.

The first topics of a store get a collection each, named after them. A server holds a file
open for each collection, so all later topics share one. There the keys of a topic begin with
a hash of its name, so that its documents lie together.

`hybridlog.topics` lists the topics. A topic is listed before its first document is written,
and never moves. Of two writers that list a topic, the first one decides.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from hybridlog_storage.lazy import lazy
from hybridlog_storage.mongo.collection_names import CATALOG_PREFIX, collection_of
from hybridlog_storage.mongo.index_documents import PREFIX_BYTES, key_bound, last_key

if TYPE_CHECKING:
    from hybridlog_storage.mongo.database import Database, ReadConcern

TOPICS: Final = f"{CATALOG_PREFIX}topics"
"""Collection that lists the topics."""
SHARED: Final = f"{CATALOG_PREFIX}shared"
"""Collection of the topics without a collection of their own."""
OWN_COLLECTIONS: Final = 256
"""Number of topics with a collection of their own. Simultaneous writers may exceed it."""

_NAMES_AT_ONCE: Final = 50_000

Filter = dict[str, object]


@dataclass(frozen=True)
class TopicPlace:
    """The place of the index documents of a topic.

    Attributes:
        topic: The topic.
        is_shared: Whether other topics lie in the same collection.
        is_listed: Whether the topic is listed. Otherwise it has no documents yet, or the list
            is damaged.
    """

    topic: str
    is_shared: bool = False
    is_listed: bool = True

    @property
    def collection(self) -> str:
        """Name of the collection."""
        return SHARED if self.is_shared else collection_of(self.topic)

    @lazy
    def prefix(self) -> bytes:
        """First bytes of the keys; empty in a collection of its own."""
        if not self.is_shared:
            return b""
        name = self.topic.encode("utf-8", "surrogatepass")
        return hashlib.sha256(name).digest()[:PREFIX_BYTES]

    def documents(self, begin: int | None = None, end: int | None = None) -> Filter:
        """A filter for the documents of the topic.

        Args:
            begin: Least log time, ns; None for any.
            end: Log time after the last, ns; None for any.
        """
        if begin is None and end is None and not self.is_shared:
            return {}
        low = self.prefix + key_bound(begin or 0)
        until = {"$lte": last_key(self.prefix)} if end is None else {}
        if end is not None:
            until = {"$lt": self.prefix + key_bound(end)}
        found: Filter = {"_id": {"$gte": low, **until}}
        # Two names may have one hash.
        return {**found, **self.of_topic}

    @property
    def of_topic(self) -> dict[str, str]:
        """A filter that the topic's documents match, and of its collection no others."""
        return {"_meta.topic": text_of(self.topic)} if self.is_shared else {}


def text_of(topic: str) -> str:
    """A topic as the text in its documents."""
    return topic.encode("utf-8", "replace").decode()


class TopicPlaces:
    """The places of topics in one database. Thread safe."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._known: dict[str, TopicPlace] = {}
        self._ensured: set[str] = set()
        self._is_full = False  # no more topics get collections of their own
        self._lock = threading.Lock()

    def of(self, topics: Collection[str]) -> dict[str, TopicPlace]:
        """The places of topics.

        Raises:
            DatabaseError: MongoDB fails.
        """
        self._read(topics)
        return {
            topic: self._known.get(topic) or TopicPlace(topic, is_listed=False) for topic in topics
        }

    def assigned(self, topics: Collection[str]) -> dict[str, TopicPlace]:
        """The places of topics whose documents are about to be written.

        Lists new topics, and creates their collections.

        Raises:
            DatabaseError: MongoDB fails.
        """
        with self._lock:
            # A place that could be rolled back is listed again, which waits for a majority.
            self._read(topics, "majority")
            new = [topic for topic in topics if topic not in self._known]
            if new:
                self._list(new)
            found = {topic: self._known[topic] for topic in topics}
            for name in {place.collection for place in found.values()}:
                self._ensure(name)
        return found

    def _ensure(self, collection: str) -> None:
        if not self._ensured:
            # One command, where creating each would be one for each topic.
            self._ensured.update(self._database.list_collections())
        if collection not in self._ensured:
            self._database.ensure_collection(collection)
            self._ensured.add(collection)

    def _list(self, topics: Sequence[str]) -> None:
        self._ensure(TOPICS)
        free = 0
        if not self._is_full:
            free = OWN_COLLECTIONS - self._database.count(TOPICS, {"shared": False})
            self._is_full = free <= 0
        self._database.insert_missing(
            TOPICS,
            [
                {"_id": collection_of(topic), "topic": text_of(topic), "shared": at >= free}
                for at, topic in enumerate(topics)
            ],
        )
        self._read(topics)

    def _read(self, topics: Collection[str], read: ReadConcern = "local") -> None:
        """Read the places of topics that are not known yet."""
        unknown = {collection_of(t): t for t in topics if t not in self._known}
        names = sorted(unknown)
        for first in range(0, len(names), _NAMES_AT_ONCE):
            chosen = {"_id": {"$in": names[first : first + _NAMES_AT_ONCE]}}
            for found in self._database.find(TOPICS, chosen, {"shared": 1}, read=read):
                topic = unknown[found["_id"]]
                self._known[topic] = TopicPlace(topic, bool(found.get("shared")))
