"""A robot's store with a recording in each state, and places to copy it to."""

from __future__ import annotations

import hashlib
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import IO, Any, cast

import pytest

import hybridlog as hl
from hybridlog.maintenance import expiry
from hybridlog.maintenance.places import Place
from hybridlog.maintenance.ssh import Server, serve
from hybridlog.record.losses import losses_of
from hybridlog.store import receiving
from hybridlog_storage.errors import HybridlogError, PayloadError, StoreError
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.payloads.logs import robot, write_log

SETTINGS = SegmentSettings(chunk_size=8 << 10, segment_size=14 << 10)
STATES = ("recorded", "damaged", "calm", "driven", "expired", "noted")
PlaceAt = Callable[[Path], AbstractContextManager[Place]]


@pytest.fixture(scope="session")
def robots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with a small recording in each state."""
    path = tmp_path_factory.mktemp("robot")
    with hl.open(path / "store", create=True, mongo="none") as store:
        for number, name in enumerate(STATES):
            log = write_log(path / f"{name}.mcap", robot(20 + number), 8 << 10)
            if name == "damaged":
                log.write_bytes(log.read_bytes()[: log.stat().st_size * 2 // 3])
            store.record(log, name=name, settings=SETTINGS)
        expire(store, "expired")
        store.edit("noted", tag={"place": "field"})
        store.edit("noted", note="it rained")
        store.mark("noted", "start", "here")
        store.pin("noted", reason="to keep")
    return path / "store"


def expire(store: hl.Store, name: str, segments: Sequence[int] = ()) -> None:
    """Delete the payloads of segments of a recording; without, of all."""
    directory, recording = store.directory, places.id_of(store.directory.path, name)
    with directory.writing(recording):
        numbers = segments or [*directory.listing(recording).sealed]
        expiry.expire(directory, recording, numbers, min_bytes=0)
    store.shared.catch_up()


@contextmanager
def directory_at(path: Path) -> Iterator[Place]:
    """A store's directory."""
    with hl.open(path, mongo="none", create=True) as store, receiving(store) as place:
        yield place


@contextmanager
def server_at(path: Path, bytes_sent: int | None = None) -> Iterator[Place]:
    """A store behind a connection, which may be cut.

    Args:
        path: The store.
        bytes_sent: Bytes that arrive before the connection is cut; None for all.
    """
    ends = [*os.pipe(), *os.pipe()]
    requests, to_server, answers, to_client = (
        os.fdopen(fd, mode, 0) for fd, mode in zip(ends, ("rb", "wb", "rb", "wb"), strict=True)
    )

    def run() -> None:
        with suppress(HybridlogError, OSError), requests, to_client, directory_at(path) as place:
            serve(place, requests, to_client)  # type: ignore[arg-type]

    thread = threading.Thread(target=run)
    thread.start()
    try:
        sent = to_server if bytes_sent is None else _Cut(to_server, bytes_sent)
        server = Server("server", cast("IO[bytes]", sent), answers)  # type: ignore[arg-type]
        with server.beating():
            yield server
    finally:
        to_server.close()
        thread.join(60)
        answers.close()


class _Cut:
    """A stream that ends after some bytes."""

    def __init__(self, stream: Any, left: int) -> None:
        self._stream = stream
        self._left = left

    def write(self, data: bytes) -> None:
        part = memoryview(data)[: self._left]
        self._left -= len(part)
        self._stream.write(part)
        if len(part) < len(data):
            self._stream.close()
            raise BrokenPipeError

    def flush(self) -> None:
        self._stream.flush()


class Disturbed:
    """A place that fails after some requests, or in the middle of bytes.

    Args:
        place: The place.
        requests: Requests that it answers; None for all.
        bytes_taken: Bytes that it takes; None for all.

    Attributes:
        asked: Names of the requests.
        taken: Bytes it took.
    """

    def __init__(
        self, place: Place, requests: int | None = None, bytes_taken: int | None = None
    ) -> None:
        self.name = place.name
        self.asked: list[str] = []
        self.taken = 0
        self._place = place
        self._requests = requests
        self._bytes = bytes_taken

    def __getattr__(self, what: str) -> Any:
        ask = getattr(self._place, what)

        def asked(*arguments: Any, **options: Any) -> Any:
            if what != "leave":
                self.asked.append(what)
                if self._requests is not None and len(self.asked) > self._requests:
                    raise StoreError("cut")
            if what == "append":
                file, at, data = arguments
                left = len(data) if self._bytes is None else self._bytes - self.taken
                part = memoryview(data)[:left]
                self.taken += len(part)
                ask(file, at, part)
                if len(part) < len(data):
                    raise StoreError("cut")
                return None
            return ask(*arguments, **options)

        return asked


def answers(path: Path, label: str) -> dict[str, Any]:
    """What a recording answers."""
    return all_answers(path, label)[label]


def all_answers(path: Path, *labels: str) -> dict[str, dict[str, Any]]:
    """What recordings answer, by label."""
    with hl.open(path, mongo="none") as store:
        return {label: _answers(store, label) for label in labels or STATES}


def _answers(store: hl.Store, label: str) -> dict[str, Any]:
    (entry,) = store.recordings(label)
    of = store.recordings(label)
    found: dict[str, Any] = {
        "entry": (entry.id, entry.status, entry.messages, entry.span, entry.tags),
        "lost": losses_of(entry),
        "notes": entry.notes,
        "pins": entry.pins,
        "marks": [(mark["time"], mark["text"]) for mark in entry.marks],
        "near": of.topic("/scan").where("ranges.min < 1.5").count(),
        "rings": of.topic("/cloud").fields("width", "height").to_arrow().to_pylist(),
    }
    for message in of.topic("/cloud", "/image", "/number", "/scan"):
        with suppress(PayloadError):
            key = (message.topic, message.log_time_ns, message.seq, message.publish_time_ns)
            found[str(key)] = message.raw
    return found


def files_in(recording: Path) -> dict[str, str]:
    """Digests of the files of a recording, but for its manifests and its locks."""
    return {
        path.relative_to(recording).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(recording.rglob("*"))
        if path.is_file() and path.suffix not in {".json", ".old", ".lock"}
    }
