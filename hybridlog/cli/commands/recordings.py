"""`hybridlog ls`, `tag`, `edit`, `mark`, `rm`; recordings as text and as JSON."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import click

from hybridlog.cli import options, output
from hybridlog.cli.options import (
    AsJson,
    Choosing,
    InStore,
    Quiet,
    argument,
    command,
    names_argument,
    one_recording,
    option,
    recordings_of,
)
from hybridlog.cli.output import Column, print_table
from hybridlog.query.choice import Choice
from hybridlog.query.times import parse_duration
from hybridlog.wording import listed
from hybridlog_storage.errors import StoreError, UsageError

if TYPE_CHECKING:
    from hybridlog_storage.catalog import RecordingSummary
    from hybridlog_storage.manifest import Pin


class _List(Choosing, InStore, AsJson):
    pass


@command(_List)
def ls_command(given: _List) -> None:
    """List the recordings."""
    with given.opened() as store:
        recordings = given.recordings_in(store.snapshot()).summaries
    found = [recording_dict(one) if given.as_json else one for one in recordings]
    without = "" if store.shared.repairs.unreadable else store.directory.when_empty
    given.show(found, RECORDINGS, without)


def _note(entry: RecordingSummary) -> str:
    notes = [] if entry.status == "complete" else [status_text(entry)]
    for number, what in ((entry.expired, "deleted"), (entry.not_copied, "not copied yet")):
        if number:
            notes.append(f"{output.counted(number, 'payload')} {what}")
    notes += (f"{key}={value}" for key, value in sorted(entry.tags.items()))
    return ", ".join([*notes, *(output.cut(note["text"]) for note in entry.notes)])


RECORDINGS = [
    Column("recording", lambda one: one.name),
    Column("start", lambda one: one.span[0] if one.span else None, "second"),
    Column(
        "duration",
        lambda one: output.short_duration(one.span[1] - one.span[0]) if one.span else "-",
        "number",
    ),
    Column("topics", lambda one: one.topic_count, "number", order=1),
    Column("messages", lambda one: one.messages, "number"),
    Column("stored", lambda one: one.stored_bytes, "bytes", order=2),
    Column("note", _note, cut=6),
]
"""Columns of a list of recordings."""
_STATUS = {
    "open": "being recorded",
    "damaged": "source damaged",
    "recovered": "cut short by a crash",
    "unfinished": "cut short by a crash, not recovered yet",
    "unproven": "manifest lost",
}


def status_text(recording: RecordingSummary) -> str:
    """The status of a recording, for people."""
    if recording.status == "damaged" and recording.has_lost_segments:
        return "stored data lost"
    return _STATUS.get(recording.status, recording.status)


def recording_dict(recording: RecordingSummary) -> dict[str, Any]:
    """A recording in short, for JSON."""
    first, last = recording.span or (None, None)
    return {
        "id": recording.id,
        "name": recording.name,
        "tags": recording.tags,
        "status": recording.status,
        "first_ns": first,
        "last_ns": last,
        "topics": recording.topic_count,
        "messages": recording.messages,
        "expired": recording.expired,
        "not_copied": recording.not_copied,
        "notes": recording.notes,
        "stored_bytes": recording.stored_bytes,
        "segments": recording.segments,
        "source": recording.source,
        "created_ns": recording.created,
    }


class _Tag(Choosing, InStore, AsJson, Quiet):
    words: tuple[str, ...] = argument(
        "A recording, as for --recording, unless options choose; and tags to set. Without "
        "tags, show them.",
        "[RECORDING] [KEY=VALUE]...",
    )
    remove: tuple[str, ...] = option("Remove this tag.", "KEY")


@command(_Tag)
def tag_command(given: _Tag) -> None:
    """Set, show or remove the tags of recordings."""
    choice, pairs = given.choice, given.words
    if choice.is_everything and not pairs:
        raise UsageError("Name a recording, or choose some: -r 'monday*', --has TOPIC.")
    if choice.is_everything:
        choice, pairs = Choice.of(pairs[0]), pairs[1:]
    with given.opened() as store:
        chosen = recordings_of(store, choice).summaries
        tags = options.parse_tags(pairs)
        found = {}
        for one in chosen:
            # Of several recordings, some may lack a tag.
            keys = [key for key in given.remove if len(chosen) == 1 or key in one.tags]
            changed = store.edit(one.id, tag=tags, untag=keys) if keys or tags else one
            found[one.name] = changed.tags
    lines = (
        f"{'' if len(found) == 1 else f'{name}: '}{key}={value}"
        for name, own in found.items()
        for key, value in sorted(own.items())
    )
    output.tell(found, lines)


class _Edit(InStore, Quiet):
    recording: str = one_recording()
    name: str | None = option("Give it this name.", "NAME")
    note: str | None = option("Write a note about it; `info` shows notes.", "TEXT")


@command(_Edit)
def edit_command(given: _Edit) -> None:
    """Give a recording another name, or write a note about it.

    The name is what people call it; nothing else of the recording changes.
    """
    if given.name is None and given.note is None:
        raise UsageError("Say what to change: --name NAME or --note TEXT.")
    with given.opened() as store:
        entry = store.edit(given.recording, name=given.name, note=given.note)
    output.tell(None, [] if given.name is None else [f"renamed to {entry.name}"])


class _Mark(InStore, Quiet):
    recording: tuple[str, ...] = option(
        "Only this recorder (id or name of its recording).",
        "RECORDING",
        short="-r",
    )
    text: str = argument("What happened.", "TEXT")
    tags: tuple[str, ...] = option("Add KEY=VALUE to it.", "K=V", name="--set-tag")
    at: str | None = option(
        "Mark a recording, also a running one, at this time, written as for --between.", "T"
    )
    until: str | None = option("The mark lasts from --at to this time.", "T2", needs=("at",))
    pin: tuple[str, str] | None = option(
        "Mark and pin so much before and after the present moment; `keep --pin` pins other times.",
        "BEFORE AFTER",
        nargs=2,
        excludes=("at", "remove"),
    )
    remove: bool = option(
        "Remove the marks with this text; with --at only what begins at this time.",
        needs=("recording",),
        excludes=("tags", "until"),
    )


@command(_Mark)
def mark_command(given: _Mark) -> None:
    """Set a mark that queries can use, now or at a past time.

    A mark answers as a message on /hybridlog/marks: `hybridlog fetch scan --where
    "/hybridlog/marks: text = 'gripper slipped'" --within 5s`.
    """
    tags, at = options.parse_tags(given.tags), given.at
    if not given.text.strip():
        raise UsageError("A mark needs a text: say what happened.")
    if (given.remove or at is not None) and len(given.recording) != 1:
        raise UsageError("A mark at a time needs one recording: name it with --recording.")
    if given.remove:
        with given.opened() as store:
            store.unmark(given.recording[0], given.text, at)
        return
    if at is None:
        marked = _mark_running(given, tags)
    else:
        with given.opened() as store:
            entry = store.mark(given.recording[0], at, given.text, tags, until=given.until)
        marked = iter([entry.name])
    for name in marked:
        output.remarks([f"Marked in {name}."])


def _mark_running(given: _Mark, tags: dict[str, str]) -> Iterator[str]:
    """Mark what recorders write at this moment, and pin the time around it; yields their names."""
    from hybridlog.live.clocks import CLOCK
    from hybridlog.live.state import choose, read
    from hybridlog.maintenance.edit import mark_now
    from hybridlog.store import store_path
    from hybridlog_storage.remote import directory_of

    around = given.pin and (parse_duration(given.pin[0]), parse_duration(given.pin[1]))
    now, directory = time.time_ns(), directory_of(store_path(given.store))
    for recording in choose(directory, given.recording):
        at = now
        with suppress(StoreError):  # it has just begun
            simulated = read(directory.path, recording).sim_time
            at = now if simulated is None else simulated
        if at == 0:
            raise UsageError(f"There is no time of {CLOCK} yet: mark again when it has come.")
        yield mark_now(directory, recording, at, given.text, tags, around=around)


class _Remove(Choosing, InStore, Quiet):
    names: tuple[str, ...] = names_argument(  # type: ignore[misc]
        what="These recordings", without="those that the options choose"
    )
    yes: bool = option("Do not ask.", short="-y")


@command(_Remove)
def rm_command(given: _Remove) -> None:
    """Delete recordings, payloads and index."""
    choice = given.choice
    if choice.is_everything:
        raise UsageError(
            "Name the recordings to delete, or choose them: -r 'monday*', --tag robot=7. "
            "`hybridlog ls` lists all; -r '*' is all of them."
        )
    with given.opened() as store:
        chosen = recordings_of(store, choice).summaries
        if not given.yes:
            pins = [pin for one in chosen for pin in store.entry(one.id).manifest.pins]
            _confirm(chosen, pins)
        for one in chosen:
            store.remove(one.id)
            output.tell(None, [f"deleted {one.name}"])


def _confirm(chosen: Sequence[RecordingSummary], pins: Sequence[Pin]) -> None:
    """Ask for consent, with what would be lost."""
    what = f"{listed(one.name for one in chosen)} for good"
    if pins:
        reasons = listed(filter(None, dict.fromkeys(pin.reason for pin in pins)))
        what += f", with {output.counted(len(pins), 'pin')} ({reasons})"
    if not sys.stdin.isatty():
        raise UsageError(f"Deleting {what} needs --yes.")
    print_table(RECORDINGS, chosen)
    if not click.confirm(f"Delete {what}?", err=True):
        output.note("Nothing is deleted.")
        raise click.exceptions.Exit(1)
