"""Sends the documents of a recording to the index."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Final

from msgspec import Struct

from hybridlog_storage.mongo.collection_names import collection_of
from hybridlog_storage.mongo.index_state import IndexState
from hybridlog_storage.threads import Threads

if TYPE_CHECKING:
    from concurrent.futures import Future

    import numpy as np
    from numpy.typing import NDArray

    from hybridlog_storage.errors import DatabaseError
    from hybridlog_storage.mongo.database import Database

_SEND_BYTES: Final = 8 << 20  # documents that are sent together, at most


class IndexTarget(Struct, frozen=True):
    """The database for the index documents of a recording.

    Attributes:
        database: The index; None if it is unavailable now, or the recording gets none.
        failure: Why it is unavailable now; None if it is not, or the recording gets none.
        renew: Returns the index, connected again if that was lost; starts the embedded MongoDB
            again if that has ended. Raises `DatabaseError`.
    """

    database: Database | None = None
    failure: DatabaseError | None = None
    renew: Callable[[], Database] | None = None

    @property
    def is_wanted(self) -> bool:
        """True if the recording gets documents, now or later."""
        return self.database is not None or self.failure is not None

    @property
    def without(self) -> str:
        """The end of a sentence about a MongoDB that is unavailable."""
        return "so the index is made later" if self.is_wanted else "so there is no index"


class Sender:
    """Sends documents to the index on a thread of its own, while more are made.

    Attributes:
        database: The index.
        messages: Number of those whose documents it has sent.
        ended: Digests of segments all of whose documents were added, by number as text.
    """

    def __init__(self, key: str, database: Database) -> None:
        self.database = database
        self.messages = 0
        self._key = key
        self._collections: set[str] = set()  # that exist
        self._thread = Threads(1, "hybridlog-send")
        self._sending: Future[None] | None = None
        self._begin()

    def _begin(self) -> None:
        self._documents: defaultdict[str, list[NDArray[np.uint8]]] = defaultdict(list)
        self._size = self._added = 0
        self.ended: dict[str, str] = {}

    def add(self, documents: Iterable[tuple[str, NDArray[np.uint8]]], messages: int) -> None:
        """Add the documents of some messages, in tables of their topics.

        Raises:
            HybridlogError: An earlier sending has failed.
        """
        for topic, table in documents:
            self._documents[topic].append(table)
            self._size += table.size
        self._added += messages
        if self._size >= _SEND_BYTES:
            self.send()

    def send(self, *, wait: bool = False) -> None:
        """Send what was added; `wait` until the index has it.

        Raises:
            HybridlogError: This sending has failed, or an earlier one.
        """
        if self._sending is not None:
            self._sending.result()
        sent = self._documents, self._added, self.ended
        self._begin()
        self._sending = self._thread.submit(self._send, *sent)
        if wait:
            self._sending.result()

    def close(self) -> None:
        """Stop sending."""
        self._thread.shutdown(wait=True, cancel_futures=True)

    def _send(
        self,
        documents: Mapping[str, list[NDArray[np.uint8]]],
        messages: int,
        segments: Mapping[str, str],
    ) -> None:
        if documents and not self._collections:
            # One command, where creating each would be one for each topic.
            self._collections.update(self.database.list_collections())
        for topic, tables in documents.items():
            name = collection_of(topic)
            if name not in self._collections:
                self.database.ensure_collection(name)
                self._collections.add(name)
            self.database.insert_raw(name, [row.tobytes() for table in tables for row in table])
        if segments:
            IndexState(self.database).put_segments(self._key, segments)
        self.messages += messages
