"""A robot's store with a recording in each state, and places to copy it to."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

import hybridlog as hl
from hybridlog.maintenance import keep
from hybridlog.record.losses import losses_of
from hybridlog_storage.errors import PayloadError
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.copying.by_hand import directories, make, pair, sshd
from tests.payloads.logs import robot, write_log
from tests.remote.conftest import address, moto, proxy, running_proxy

SETTINGS = SegmentSettings(chunk_size=8 << 10, segment_size=14 << 10)
STATES = ("recorded", "damaged", "calm", "driven", "expired", "noted")

__all__ = ["address", "directories", "make", "moto", "pair", "proxy", "running_proxy", "sshd"]


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


def expire(store: hl.Store, name: str, which: Sequence[int] = ()) -> None:
    """Delete logs of a recording, by their places among those that may go; all by default."""
    directory, recording = store.directory, places.id_of(store.directory.path, name)
    with directory.writing(recording):
        logs = directory.manifests.read(recording).logs
        numbers = [number for number, log in logs.items() if log.number != log.group]
        keep.expire(directory, recording, [numbers[n] for n in which] or numbers)
    store.shared.catch_up()


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
        "notes": entry.manifest.notes,
        "pins": entry.manifest.pins,
        "marks": [(mark.time, mark.text) for mark in entry.manifest.marks],
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
