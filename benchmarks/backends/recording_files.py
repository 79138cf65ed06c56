"""What the backends that write recording files have in common."""

from __future__ import annotations

import os
import threading
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Protocol

from benchmarks.backends.base import Backend, BackendFailedError

if TYPE_CHECKING:
    from hybridlog_storage.messages import Channel


class Recorder(Protocol):
    """What writes one file."""

    def write(self, channel: int, log_time: int, payload: bytes) -> None:
        """Append a message."""

    def close(self) -> None:
        """Write what belongs at the end, and close the file."""


class FileBackend(Backend):
    """Recorders under one lock: files are written by one thread at a time."""

    suffix: ClassVar[str]
    """Of the files' names."""

    def __init__(self, directory: Path) -> None:
        super().__init__(directory)
        self.path = directory / f"recording{self.suffix}"
        """The file."""
        self._channels: Sequence[Channel] = ()
        self._recorder: Recorder | None = None
        self._lock = threading.Lock()

    def open(self, channels: Sequence[Channel]) -> None:
        self._channels = channels
        if not self.path.exists():
            with self._failures():
                self._recorder = self._record(self.path)

    def insert(self, channel: int, log_time: int, payload: bytes) -> None:
        with self._lock, self._failures():
            assert self._recorder is not None
            self._recorder.write(channel, log_time, payload)

    def finish(self) -> None:
        with self._lock:
            recorder, self._recorder = self._recorder, None
            if recorder is not None:
                with self._failures():
                    recorder.close()
                    for place in (self.path, self.directory):
                        descriptor = os.open(place, os.O_RDONLY)
                        try:
                            os.fsync(descriptor)
                        finally:
                            os.close(descriptor)

    def counts(self) -> Mapping[str, int]:
        found = dict.fromkeys((channel.topic for channel in self._channels), 0)
        with self._failures():
            return found | self._count(self.path)

    def close(self) -> None:
        with self._lock:
            recorder, self._recorder = self._recorder, None
            if recorder is not None:
                with suppress(Exception):  # on a full disk there is no good end
                    recorder.close()

    @abstractmethod
    def _record(self, path: Path) -> Recorder:
        """Begin a file."""

    @abstractmethod
    def _count(self, path: Path) -> Mapping[str, int]:
        """Read all messages of a file and count them by topic."""

    @contextmanager
    def _failures(self) -> Iterator[None]:
        """Whatever a package raises is a failure of the backend."""
        try:
            yield
        except Exception as error:
            of_system = isinstance(error, OSError) and error.strerror
            reason = of_system or str(error)
            raise BackendFailedError(f"{self.name}: {type(error).__name__}: {reason}") from error
