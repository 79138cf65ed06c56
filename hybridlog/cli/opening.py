"""Opening the store for a command, with a word about what had to be mended."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from hybridlog.cli.output import counted, note
from hybridlog.cli.progress import LateBar

if TYPE_CHECKING:
    from hybridlog.store import Store
    from hybridlog_storage.recovery import Recovered


@contextmanager
def opened(
    path: Path | None,
    mongo: str | None,
    *,
    create: bool = False,
    needs_database: bool = False,
    quiet: bool = False,
) -> Iterator[Store]:
    """A store.

    Args:
        path: Its directory; without, `HYBRIDLOG_STORE` or `./hybridlog-store`.
        mongo: URI of the MongoDB that holds the index.
        create: Make it if there is none.
        needs_database: Fail when MongoDB is away.
        quiet: No progress while the index is brought up to date.
    """
    from hybridlog.store import open_store

    bar = LateBar("indexing", quiet=quiet)
    try:
        store = open_store(
            path, mongo=mongo, create=create, require_database=needs_database, progress=bar
        )
    finally:
        bar.close()
    with store:
        _tell(store)
        yield store


def _tell(store: Store) -> None:
    tended = store.tended
    for recording, segments in tended.recovered.items():
        _tell_recovered(recording, segments)
    for recording, chunks in tended.indexed.items():
        if chunks and recording not in tended.recovered:
            note(f"Recording {recording}: {counted(chunks, 'chunk')} added to the index.")
    for recording in tended.removed:
        note(f"Recording {recording} has no files any more; it is out of the index.")
    for recording, problem in tended.unreadable.items():
        note(f"Recording {recording} cannot be brought into the index: {problem}")
    if store.without_database is not None:
        note(
            f"MongoDB is away, so only topics and times can be asked for: {store.without_database}"
        )


def _tell_recovered(recording: str, segments: list[Recovered]) -> None:
    kept = sum(s.messages for s in segments)
    if not any(s.path for s in segments):
        note(f"Recording {recording} was cut short by a crash before anything was stored.")
        return
    note(
        f"Recording {recording} was cut short by a crash: {counted(kept, 'message')} of it "
        "are recovered."
    )
    for segment in segments:
        for damage in segment.damage:
            note(f"  damaged: {damage}")
