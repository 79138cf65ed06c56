"""Copies of a recording that goes on, whose lock is held as its recorder does."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import hybridlog as hl
from tests import places
from tests.running.methods import LABEL
from tests.running.running import NO_MONGODB, Running


def copy_of(running: Running, path: Path) -> Path:
    """A copy of the store's directory, made while its recording goes on."""
    shutil.copytree(running.path, path, ignore=shutil.ignore_patterns("mongod", "*.sock"))
    return path


def folder(store: Path) -> Path:
    """The directory of the recording."""
    return places.folder(store, LABEL)


def open_segment(store: Path) -> Path:
    """The segment that is being written."""
    (path,) = folder(store).glob("*.mcap.open")
    return path


@contextmanager
def as_running(store: Path) -> Iterator[hl.Store]:
    """A handle of a copy, as if its recorder still wrote it."""
    fd = os.open(folder(store) / "writer.lock", os.O_RDWR)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX)
        with hl.open(store, mongo=NO_MONGODB) as opened:
            yield opened
    finally:
        os.close(fd)
