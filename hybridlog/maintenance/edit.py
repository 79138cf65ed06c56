"""Edits recordings: name, tags, notes and marks; and removes them."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING

from hybridlog.entries import free_name_in, text
from hybridlog.maintenance import tables
from hybridlog.query.times import TimeLike, format_time, parse_time
from hybridlog.record.losses import extent_of
from hybridlog_storage.disk.directory import LOCK_WAIT_S, gone
from hybridlog_storage.errors import (
    ConnectionLostError,
    RecordingGoneError,
    StoreError,
    TimeError,
    UsageError,
)
from hybridlog_storage.manifest import (
    MAX_MARKS,
    Manifest,
    Mark,
    Pin,
    new_random,
    replace,
    with_mark,
)
from hybridlog_storage.mongo.index_state import IndexState

if TYPE_CHECKING:
    from hybridlog.opened import OpenStore
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.mongo.database import Database


def change(
    shared: OpenStore,
    entry: RecordingEntry,
    how: Callable[[Manifest], Manifest],
    name: str | None = None,
) -> RecordingEntry:
    """Change the manifest of a recording, also of a running one, and give it another name.

    The name gets a number if another recording has it; None to leave it. Returns the changed
    recording.
    """
    directory = shared.directory
    directory.check_changes()
    with ExitStack() as held:
        if name is not None:
            held.enter_context(directory.manifests.creating())
            free, others = free_name_in(shared.newest().summaries, name, entry.id), how

            def how(now: Manifest) -> Manifest:
                return replace(others(now), name=free)

        try:
            directory.manifests.change(entry.id, how)
        except RecordingGoneError as error:
            raise gone(entry.name) from error
    shared.catch_up(entry.id)
    return shared.now().entry(entry.id)


def time_of_mark(entry: RecordingEntry, moment: TimeLike) -> int:
    """Log time of a mark's beginning or end, ns.

    Outside of a recording, a mark would become its beginning or end, from which relative times
    count. One that is running has not ended yet.
    """
    start, end = extent_of(entry)
    time = parse_time(moment, start=start, end=end)
    has_messages = entry.messages > len(entry.marks)
    if entry.status == "open":
        end = max(end, clock.time_ns())
    if has_messages and not start <= time <= end:
        ends = f"begins at {format_time(start)}" if time < start else f"ends at {format_time(end)}"
        is_ = f"{moment} is {format_time(time)}, and " if isinstance(moment, str) else ""
        raise TimeError(
            f"{is_ or f'A mark cannot be at {format_time(time)}: '}{entry.name} {ends}; ten "
            "seconds from its beginning are +10s, ten before its end -10s."
        )
    return time


def mark(
    shared: OpenStore,
    entry: RecordingEntry,
    moment: int,
    *,
    text: str,
    tags: Mapping[str, str],
    end: int | None = None,
) -> RecordingEntry:
    """Set a mark in the manifest of a recording, also of a running one, and return it.

    `moment` and `end` are log times, ns; without `end` it is the mark of a moment.
    """
    if moment < 0:
        raise TimeError("A mark cannot be set before 1970: its log time has no sign.")
    if end is not None and end < moment:
        raise TimeError("A mark cannot end before it begins.")
    made = Mark(new_random(), moment, text, dict(tags), end)
    now = change(shared, entry, lambda known: with_mark(known, made))
    if all(one["id"] != made.id for one in now.marks):
        raise too_many_marks(entry.name)
    return now


def mark_now(
    directory: StoreDirectory,
    recording: str,
    now: int,
    note: str,
    tags: Mapping[str, str],
    *,
    around: tuple[int, int] | None = None,
) -> str:
    """Set a mark at the present moment of a recording that goes on; returns its name.

    `now` is its log time, ns; `around` the time before and after it that is marked and pinned, ns,
    None for none.
    """
    key, said = new_random(), {text(one): text(value) for one, value in tags.items()}

    def how(known: Manifest) -> Manifest:
        if around is None:
            return with_mark(known, Mark(key, now, text(note), said))
        begin, end = max(now - around[0], 0), now + around[1]
        pins = (*known.pins, Pin(key, begin, end, reason=text(note)))
        # A mark from before the first message would become the beginning of the recording.
        begin = max(begin, min(known.created, now))
        return with_mark(replace(known, pins=pins), Mark(key, begin, text(note), said, end))

    found = directory.manifests.change(recording, how)
    if all(one.id != key for one in found.marks):
        raise too_many_marks(found.name)
    return found.name


def too_many_marks(name: str) -> StoreError:
    """The error for a mark that is counted, and not kept."""
    return StoreError(
        f"{name} has {MAX_MARKS:,} marks, the most that a recording can have: this one is counted, "
        "and not kept. Remove others with `hybridlog mark --remove`."
    )


def unmark(
    shared: OpenStore, entry: RecordingEntry, moment: int | None, *, text: str
) -> RecordingEntry:
    """Remove marks of a text, at a log time (ns) or None for any, and return the recording."""

    def how(now: Manifest) -> Manifest:
        left = tuple(one for one in now.marks if one.text != text or moment not in {None, one.time})
        if len(left) == len(now.marks):
            when = "" if moment is None else " at this time"
            raise UsageError(
                f"{entry.name} has no mark {text!r}{when} that somebody set: those that its "
                "recorder noted are messages, and stay."
            )
        return replace(now, marks=left)

    return change(shared, entry, how)


def remove_if(
    shared: OpenStore, recording: str, check: Callable[[Manifest], None] = lambda _: None
) -> None:
    """Delete a recording of an open store.

    Its manifest says so first, then its files go, then the manifest; who may write finishes what
    was interrupted. `check` is called with the newest manifest, and raises to keep the recording.
    If MongoDB fails, the files are gone, and the next connection clears it.
    """
    directory = shared.directory
    try:
        entry = shared.now().entry(recording)
        database = shared.index.writable_database
        with directory.writing(entry.id, entry.name, wait_s=LOCK_WAIT_S):
            try:
                directory.manifests.remove(entry.id, check)
            except RecordingGoneError as error:
                raise gone(entry.name) from error
            with suppress(OSError, StoreError):  # or else the next opening does both
                tables.remove(directory, entry.id, entry)
                shared.catalog.remove(entry.id)
            if database is not None:
                _clear(database, entry)
    except ConnectionLostError:
        shared.invalidate()
        shared.index.connect()  # a new connection removes the rest
    finally:
        shared.catch_up()


def _clear(database: Database, entry: RecordingEntry) -> None:
    """Remove a recording from the index."""
    state = IndexState(database)
    state.begin(entry)
    state.clear(entry)
    state.remove([entry.key])
