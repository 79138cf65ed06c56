"""Edits recordings: name, tags, notes and marks; and removes them."""

from __future__ import annotations

import secrets
import time as clock
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING

from hybridlog.entries import free_name_in, text
from hybridlog.maintenance.opening import remove_tables
from hybridlog.query.times import TimeLike, format_time, parse_range, parse_time
from hybridlog_storage.disk.directory import LOCK_WAIT_S, StoreDirectory, gone
from hybridlog_storage.errors import (
    DatabaseError,
    RecordingGoneError,
    StoreError,
    TimeError,
    UsageError,
)
from hybridlog_storage.manifest import (
    MAX_MARKS,
    Manifest,
    Mark,
    Note,
    Pin,
    new_random,
    replace,
)
from hybridlog_storage.mongo.index_documents import IndexState

if TYPE_CHECKING:
    from hybridlog.opened import OpenStore
    from hybridlog_storage.catalog import RecordingEntry


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
    start, end = entry.extent
    time = parse_time(moment, start=start, end=end)
    if entry.status == "open":
        end = max(end, clock.time_ns())
    if entry.messages > len(entry.manifest.marks) and not start <= time <= end:
        ends = f"begins at {format_time(start)}" if time < start else f"ends at {format_time(end)}"
        raise TimeError(
            f"A mark cannot be at {format_time(time)}: {entry.name} {ends}; ten seconds from its "
            "beginning are +10s, ten before its end -10s."
        )
    return time


def edit(
    shared: OpenStore,
    recording: str | RecordingEntry,
    *,
    name: str | None,
    note: str | None,
    tag: Mapping[str, str],
    untag: Sequence[str],
) -> RecordingEntry:
    """Change what is said about a recording, as of `Store.edit`."""
    for what, given in (("name", name), ("note", note)):
        if given is not None and not (isinstance(given, str) and given.strip()):
            raise UsageError(f"A {what} needs a text: give one that is not empty.")
    if not isinstance(tag, Mapping) or not all(
        isinstance(key, str) and key and "\0" not in key and isinstance(value, str)
        for key, value in tag.items()
    ):
        raise UsageError('Tags are texts by keys, not empty and without NUL: tag={"place": "lab"}.')
    (entry,) = shared.now().select([recording])
    for key in untag:
        if key not in entry.tags:
            known = ", ".join(sorted(entry.tags)) or "none"
            raise UsageError(f"{entry.name} has no tag {key!r}. Its tags: {known}.")
    new = {text(key): text(value) for key, value in tag.items()}
    notes = () if note is None else (Note(clock.time_ns(), text(note)),)

    def how(now: Manifest) -> Manifest:
        left = {key: value for key, value in now.tags.items() if key not in untag}
        return replace(now, tags={**left, **new}, notes=(*now.notes, *notes))

    return change(shared, entry, how, name)


def pin(
    shared: OpenStore,
    recording: str | RecordingEntry,
    span: tuple[TimeLike | None, TimeLike | None],
    topics: Sequence[str] | None,
    reason: str,
) -> str:
    """Pin a time of a recording, as of `Store.pin`."""
    (entry,) = shared.now().select([recording])
    start, stop = entry.extent
    if span != (None, None):
        parse_range(*span, start=start, end=stop)
    begin, end = (None if t is None else parse_time(t, start=start, end=stop) for t in span)
    if not may_hold(entry, begin, end):
        raise TimeError(f"Nothing to pin: recording {entry.name!r} has no message then.")
    made = pin_of(secrets.token_hex(4), (begin, end), topics, text(reason))

    def how(now: Manifest) -> Manifest:
        return replace(now, pins=(*(one for one in now.pins if one.id != made.id), made))

    change(shared, entry, how)
    return made.id


def unpin(shared: OpenStore, names: Sequence[str]) -> None:
    """Remove pins; UsageError if there is none of a name."""

    def how(now: Manifest) -> Manifest:
        return replace(now, pins=tuple(one for one in now.pins if one.id not in names))

    known = {one.id: entry for entry in shared.now().select(None) for one in entry.manifest.pins}
    for name in names:
        if name not in known:
            raise UsageError(f"There is no pin {name!r}; `hybridlog keep --pins` lists them.")
    for entry in {known[name].id: known[name] for name in names}.values():
        change(shared, entry, how)


def may_hold(entry: RecordingEntry, begin: int | None, end: int | None) -> bool:
    """True if a recording may have messages in a range of time; a running one, later ones."""
    start, stop = entry.extent
    is_over = entry.status not in {"open", "unfinished"}
    return (end is None or end > start) and not (is_over and begin is not None and begin >= stop)


def pin_of(
    name: str, span: tuple[int | None, int | None], topics: Sequence[str] | None, reason: str
) -> Pin:
    """A pin of `[first, end)` of log time, ns, with None for no bound; without topics, of all."""
    begin, end = span
    last = None if end is None else end - 1
    return Pin(name, begin, last, None if topics is None else tuple(topics), reason)


def mark(
    shared: OpenStore,
    recording: str,
    span: tuple[TimeLike, TimeLike | None],
    note: str,
    tags: Mapping[str, str],
) -> RecordingEntry:
    """Set a mark in the manifest of a recording, as of `Store.mark`."""
    entry = shared.now().entry(recording)
    begin, end = (None if one is None else time_of_mark(entry, one) for one in span)
    assert begin is not None
    if begin < 0:
        raise TimeError("A mark cannot be set before 1970: its log time has no sign.")
    if end is not None and end < begin:
        raise TimeError("A mark cannot end before it begins.")
    said = {text(key): text(value) for key, value in tags.items()}
    made = Mark(new_random(), begin, text(note), said, end)
    return change(shared, entry, lambda now: _marked(now, made))


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
            return _marked(known, Mark(key, now, text(note), said))
        begin, end = max(now - around[0], 0), now + around[1]
        pins = (*known.pins, Pin(key, begin, end, reason=text(note)))
        # A mark from before the first message would become the beginning of the recording.
        begin = max(begin, min(known.created, now))
        return _marked(replace(known, pins=pins), Mark(key, begin, text(note), said, end))

    return directory.manifests.change(recording, how).name


def _marked(manifest: Manifest, made: Mark) -> Manifest:
    if len(manifest.marks) >= MAX_MARKS:
        raise StoreError(
            f"{manifest.name} has {MAX_MARKS:,} marks, the most that a recording can have. Remove "
            "others with `hybridlog mark --remove`."
        )
    return replace(manifest, marks=(*manifest.marks, made))


def unmark(shared: OpenStore, recording: str, moment: TimeLike | None, note: str) -> RecordingEntry:
    """Remove marks of a text, at a log time or None for any, and return the recording."""
    entry = shared.now().entry(recording)
    start, end = entry.extent
    time = None if moment is None else parse_time(moment, start=start, end=end)

    def how(now: Manifest) -> Manifest:
        gone = [one for one in now.marks if one.text == text(note) and time in {None, one.time}]
        if not gone:
            when = "" if time is None else " at this time"
            raise UsageError(
                f"{entry.name} has no mark {note!r}{when} that somebody set: those that its "
                "recorder noted are messages, and stay."
            )
        return replace(now, marks=tuple(one for one in now.marks if one not in gone))

    return change(shared, entry, how)


def remove_if(
    shared: OpenStore,
    recording: str,
    check: Callable[[Manifest], None] = lambda _: None,
    *,
    clears: bool = True,
) -> None:
    """Delete a recording of an open store.

    Its manifest says so first, then its files go, then the manifest; who may write finishes what
    was interrupted. `check` is called with the newest manifest, and raises to keep the recording.
    If MongoDB fails, or is not to be waited for (`clears`), the next connection clears it.
    """
    directory = shared.directory
    try:
        entry = shared.now().entry(recording)
        database = shared.index.reached() if clears else None
        with directory.writing(entry.id, entry.name, wait_s=LOCK_WAIT_S):
            try:
                directory.manifests.remove(entry.id, check)
            except RecordingGoneError as error:
                raise gone(entry.name) from error
            with suppress(OSError, StoreError):  # or else the next change does both
                remove_tables(directory, entry.id, entry)
                shared.catalog.remove(entry.id)
            if database is not None:
                with suppress(DatabaseError):
                    state = IndexState(database)
                    state.begin(entry)
                    state.clear(entry)
                    state.remove([entry.key])
    finally:
        shared.catch_up()
