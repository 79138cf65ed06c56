"""Rows of the logs of a recording whose payloads are gone."""

from __future__ import annotations

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
    """The files of rows of one recording; nothing is read before it is needed. Thread safe."""

    def __init__(self, recording: Path, cache: Cache | None = None) -> None:
        self._recording = recording
        self._cache = cache or Cache()
        self._files: dict[int, tuple[list[RowsFile], str]] = {}  # by log, and what is wrong

    @lazy
    def _listed(self) -> Mapping[int, Sequence[File]]:
        """The files that its manifest lists, by number of their log."""
        manifest = manifests_at(self._recording).find(self._recording.name)
        return {} if manifest is None else manifest.rows

    def left(self, log: int, chunk: int) -> tuple[Batch, NDArray[np.int64]]:
        """The rows that remain of a chunk, and the arrival numbers of its messages."""
        from hybridlog.columns.rows import messages_left

        if log not in self._files:
            self._files[log] = self._open(log)
        files, problems = self._files[log]
        try:
            found = [part for file in files for part in file.of_chunk(chunk)]
        except StoreError as error:
            raise SegmentError(f"{error}{_RESTORE}") from error
        if not found:
            problems = problems or f"Rows are in no file of {self._recording}."
            raise SegmentError(f"{problems}{_RESTORE}")
        return messages_left(found)

    def _open(self, log: int) -> tuple[list[RowsFile], str]:
        from hybridlog.columns.rows_file import RowsFile

        files: list[RowsFile] = []
        problems: list[str] = []
        for listed in self._listed.get(log, ()):
            try:
                files.append(RowsFile(self._recording, listed, self._cache))
            except StoreError as error:
                problems.append(str(error))
        return files, " ".join(problems)
