"""Opens the store for a command and reports the repairs that this took."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain, islice
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any, Final

import click

from hybridlog.cli.output import Bar, counted, note, notes
from hybridlog.wording import listed
from hybridlog_storage.errors import StoreError, WithoutMongoError

if TYPE_CHECKING:
    from hybridlog.store import Store

_MAX_LISTED = 3  # names of recordings or stores
_MAX_FOLDERS = 1000
_READING: Final = ("Look", "Ask", "Export")
"""Groups of commands that take the only store that is near; others name it."""


@contextmanager
def opened_store(
    path: Path | None,
    mongo: str | None,
    *,
    quiet: bool = False,
    snapshot: bool = False,
    records: bool = False,
    verifies: bool = False,
    **how: Any,
) -> Iterator[Store]:
    """The open store, in a block around which its repairs are reported.

    With `snapshot`, all that the command asks is of one moment. With `records` it records, also
    while MongoDB is unavailable; with `verifies` it says itself what `hybridlog verify --repair`
    cures.
    """
    from hybridlog_storage.lazy import import_numpy_late

    import_numpy_late()
    from hybridlog.store import open_store

    near = [] if path or how.get("create") else _stores_near()
    if len(near) == 1 and _reads():
        path = near[0]
        note(f"Store: {path}, the only one below this folder.")
    try:
        with Bar("indexing", quiet=quiet) as bar:
            store = open_store(path, mongo=mongo, progress=bar.part, **how)
    except StoreError as error:
        if near and path is None:
            named = " or ".join(f"--store {quote(str(one))}" for one in near[:_MAX_LISTED])
            error.add_note(f"Below this folder: {named}.")
        raise
    with store:
        doing = "so the files answer"
        if records:
            doing = store.shared.index.index_to_record("Recording").without
        told = _repairs(store, doing, verifies=verifies)
        notes(told)
        try:
            yield store.snapshot() if snapshot else store
        finally:
            later = _repairs(store, "" if records else doing, verifies=verifies)
            notes(one for one in later if one not in told)


def _stores_near() -> list[Path]:
    """The stores up to two levels below this folder; none if one is named."""
    from hybridlog.store import store_path
    from hybridlog_storage.settings import NAME

    if os.environ.get("HYBRIDLOG_STORE") or store_path().exists():
        return []
    folders = chain.from_iterable(
        islice(Path().glob(depth), _MAX_FOLDERS) for depth in ("*", "*/*")
    )
    return sorted(folder for folder in folders if (folder / NAME).is_file())


def _reads() -> bool:
    """True in a command that only reads the store."""
    from hybridlog.cli.app import GROUPS

    context = click.get_current_context(silent=True)
    return context is not None and any(context.info_name in GROUPS[one] for one in _READING)


def _repairs(store: Store, doing: str, *, verifies: bool) -> list[str]:
    """Sentences about repairs since the last call, what cannot be mended, and what is missing."""
    repairs, found = store.repairs, list[str]()
    for recording, segments in repairs.recovered.items():
        kept = counted(sum(one.messages for one in segments), "message")
        found.append(f"Recording {recording} was cut short by a crash: {kept} of it are recovered.")
        found += (f"  damaged: {damage}" for one in segments for damage in one.damage)
    found += (
        f"Recording {recording} cannot be read: {reason}"
        for recording, reason in repairs.unreadable.items()
        if not (verifies and "`hybridlog verify --repair`" in reason)
    )
    if not (store.directory.is_writable or store.directory.is_remote):
        found.append(f"The store {store.directory.path} is read-only; its segments answer.")
    if repairs.damage:
        found.append("The data files of the embedded MongoDB were damaged, and were replaced.")
    if indexed := {r: n for r, n in repairs.indexed.items() if n and r not in repairs.recovered}:
        added = counted(sum(indexed.values()), "chunk")
        found.append(f"{listed(indexed, _MAX_LISTED)}: {added} added to the index.")
    if repairs.removed:
        found.append(f"{listed(repairs.removed)}: no files any more, so out of the index.")
    reason = store.shared.index.unavailable
    is_wanted = reason is not None and not isinstance(reason, WithoutMongoError)
    if doing and is_wanted and store.directory.is_writable:
        found.append(f"MongoDB is unavailable, {doing}: {reason}")
    for done in (repairs.damage, repairs.indexed, repairs.removed):
        done.clear()
    return found
