"""Rows of the logs of a recording whose payloads are gone."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Final

from hybridlog_storage.cache import Cache, lazy
from hybridlog_storage.errors import SegmentError, StoreError
from hybridlog_storage.manifests import manifests_at

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from hybridlog.columns.rows_file import RowsFile
    from hybridlog_storage.manifest import File
    from hybridlog_storage.messages import Batch


_RESTORE: Final = " Restore it from a copy; `hybridlog verify` shows what is affected."


class RecordingRows:
    """The files of rows of one recording. Thread safe.

    Nothing is read before it is needed.
    """

    def __init__(self, recording: Path, cache: Cache | None = None) -> None:
        self._recording = recording
        self._cache = cache or Cache()
        self._readers: dict[int, list[RowsFile | StoreError]] = {}  # by number of the log
        self._lock = threading.RLock()

    @lazy
    def _listed(self) -> Mapping[int, Sequence[File]]:
        """The files that its manifest lists, by number of their log."""
        manifest = manifests_at(self._recording).find(self._recording.name)
        return {} if manifest is None else manifest.rows

    def left(self, log: int, chunk: int) -> tuple[Batch, NDArray[np.int64]]:
        """The rows that remain of a chunk, and the arrival numbers of its messages."""
        from hybridlog.columns.left_rows import messages_left

        files = self._of(log)
        readable = [file for file in files if not isinstance(file, StoreError)]
        try:
            found = [file.of_chunk(chunk) for file in readable if chunk in file.places]
        except StoreError as error:
            raise SegmentError(f"{error}{_RESTORE}") from error
        if not found:
            problems = " ".join(str(file) for file in files if isinstance(file, StoreError))
            problems = problems or f"Rows are in no file of {self._recording}."
            raise SegmentError(f"{problems}{_RESTORE}")
        return messages_left(found)

    def _of(self, log: int) -> list[RowsFile | StoreError]:
        """The files of rows of a log, or what is wrong with them."""
        from hybridlog.columns.rows_file import RowsFile

        with self._lock:
            found = self._readers.get(log)
            if found is None:
                found = self._readers[log] = []
                for listed in self._listed.get(log, ()):
                    try:
                        found.append(RowsFile(self._recording, listed, self._cache))
                    except StoreError as error:
                        found.append(error)
            return found
