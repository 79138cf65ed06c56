"""The logs of a recording: those that are here, and what is left of those that are gone."""

from __future__ import annotations

import threading
from collections import defaultdict
from typing import TYPE_CHECKING

from hybridlog_storage.cache import Cache
from hybridlog_storage.errors import SegmentError, StoreError
from hybridlog_storage.lazy import lazy
from hybridlog_storage.manifests import manifests_at

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from hybridlog.columns.column_file import OpenFiles
    from hybridlog.columns.rows_file import RowsFile
    from hybridlog.columns.topic_table import TopicTable
    from hybridlog_storage.manifest import File
    from hybridlog_storage.messages import Batch


class RecordingRows:
    """The files of rows of one recording. Thread safe.

    Nothing is read before it is needed.
    """

    def __init__(self, recording: Path, cache: Cache | None = None) -> None:
        self._recording = recording
        self._cache = cache or Cache()
        self._readers: dict[int, list[RowsFile]] = {}  # by number of the log
        self._problems: defaultdict[int, list[str]] = defaultdict(list)  # of files, by log
        self._lock = threading.RLock()

    @lazy
    def _listed(self) -> Mapping[int, Sequence[File]]:
        """The files that its manifest lists, by number of their log."""
        manifest = manifests_at(self._recording).find(self._recording.name)
        return {} if manifest is None else manifest.rows

    def left(self, log: int, chunk: int) -> tuple[Batch, NDArray[np.int64]]:
        """The rows that remain of a chunk, and the arrival numbers of its messages."""
        from hybridlog.columns.left_rows import messages_left
        from hybridlog.columns.rows_file import RESTORE

        try:
            found = [file.of_chunk(chunk) for file in self._of(log) if chunk in file.places]
        except StoreError as error:
            raise SegmentError(f"{error}{RESTORE}") from error
        if not found:
            raise self._missing(log)
        return messages_left(found)

    def expired_fields(
        self, topic: str, chunks: Mapping[tuple[int, int], int], opened: OpenFiles
    ) -> TopicTable:
        """The fields of a topic in chunks of logs that are gone as a table, in no order.

        `chunks` has the number of its messages by log and chunk. Errors are those of `left`.
        """
        from hybridlog.columns.column_file import TablePart
        from hybridlog.columns.layout import TopicCounts
        from hybridlog.columns.topic_table import TopicTable

        parts = [
            TablePart(file, *file.places[chunk])
            for log, chunk in chunks
            for file in self._of(log)
            if file.topic == topic and chunk in file.places
        ]
        rows = sum(part.rows for part in parts)
        if rows != sum(chunks.values()):
            raise self._missing(*{log for log, _ in chunks})
        return TopicTable(topic, parts, TopicCounts(rows), opened)

    def _missing(self, *logs: int) -> SegmentError:
        problems = [one for log in sorted(logs) for one in self._problems[log]]
        return SegmentError(" ".join(problems) or f"Rows are in no file of {self._recording}.")

    def _of(self, log: int) -> list[RowsFile]:
        """The files of rows of a log, but for damaged or missing ones."""
        from hybridlog.columns.rows_file import RowsFile

        with self._lock:
            found = self._readers.get(log)
            if found is None:
                found = self._readers[log] = []
                for listed in self._listed.get(log, ()):
                    try:
                        found.append(RowsFile(self._recording, listed, self._cache))
                    except StoreError as error:
                        self._problems[log].append(str(error))
            return found
