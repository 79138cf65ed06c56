"""`hybridlog edit`, `tag`, `mark` and `rm`."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from hybridlog.cli import options, output
from hybridlog.cli.binder import argument, command, option
from hybridlog.cli.completion import complete_recording
from hybridlog.cli.ls import RECORDINGS
from hybridlog.cli.options import (
    AsJson,
    Choosing,
    InStore,
    Named,
    Quiet,
    Running,
    names_argument,
    one_recording,
    recordings_of,
)
from hybridlog.cli.render import print_table
from hybridlog.cli.signals import if_stopped
from hybridlog.query.choice import Choice
from hybridlog.wording import listed
from hybridlog_storage.errors import StoreError, UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hybridlog.recordings import Recordings
    from hybridlog.store import Store
    from hybridlog_storage.summary import RecordingSummary


@dataclass(frozen=True, kw_only=True)
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
        (entry,) = store.select([given.recording])
        entry = store.edit(entry.id, name=given.name, note=given.note)
    if given.name is not None and not given.quiet:
        output.say(f"renamed to {entry.name}")


@dataclass(frozen=True, kw_only=True)
class _Tag(Choosing, InStore, AsJson, Quiet):
    words: tuple[str, ...] = argument(
        "A recording, as for --recording, unless options choose; and tags to set. Without "
        "tags, show them.",
        "[RECORDING] [KEY=VALUE]...",
        shell_complete=complete_recording,
    )
    remove: tuple[str, ...] = option("Remove this tag.", "KEY")


@command(_Tag)
def tag_command(given: _Tag) -> None:
    """Set, show or remove the tags of recordings."""
    with given.opened() as store:
        chosen, pairs, is_one = _named_or_chosen(store, given)
        tags = options.parse_tags(pairs)
        found = {}
        for one in chosen.summaries:
            # Of several recordings, some may lack a tag.
            keys = given.remove if is_one else [key for key in given.remove if key in one.tags]
            changed = store.edit(one.id, tag=tags, untag=keys) if keys or tags else one
            found[one.name] = changed.tags
    lines = (
        f"{'' if is_one else f'{name}: '}{key}={value}"
        for name, own in found.items()
        for key, value in sorted(own.items())
    )
    given.tell(next(iter(found.values())) if is_one else found, lines)


def _named_or_chosen(store: Store, given: _Tag) -> tuple[Recordings, Sequence[str], bool]:
    """The recordings, by the first word or options; the other words; whether one is named."""
    from hybridlog.query.choosing import is_one

    choice, words = given.choice, given.words
    if not choice.is_everything:
        return recordings_of(store, choice), words, False
    if not words:
        raise UsageError("Name a recording, or choose some: -r 'monday*', --has TOPIC.")
    named = Choice.of(words[0])
    return recordings_of(store, named), words[1:], is_one(store.session, named.name)


@dataclass(frozen=True, kw_only=True)
class _Mark(Running):
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
        from hybridlog.query.times import parse_duration

        before, after = map(parse_duration, given.pin or ("0s", "0s"))
        around = None if given.pin is None else (before, after)
        marked = _mark_running(given.text, tags, around, given.recording, given.store)
    else:
        (recording,) = given.recording
        with given.opened() as store:
            marked = iter([store.mark(recording, at, given.text, tags, until=given.until).name])
    for name in marked:
        if not given.quiet:
            output.note(f"Marked in {name}.")


def _mark_running(
    text: str,
    tags: dict[str, str],
    around: tuple[int, int] | None,
    recordings: tuple[str, ...],
    store: Path | None,
) -> Iterator[str]:
    """Mark what recorders write at this moment, and pin the time around it; yields their names."""
    from hybridlog.live.clocks import CLOCK
    from hybridlog.live.state import choose, read
    from hybridlog.maintenance.edit import mark_now
    from hybridlog.store import store_path
    from hybridlog_storage.remote import directory_of

    now, directory = time.time_ns(), directory_of(store_path(store))
    for recording in choose(directory, recordings):
        simulated: int | None = None
        with suppress(StoreError):  # it has just begun
            simulated = read(directory.path, recording).sim_time
        if simulated == 0:
            raise UsageError(f"There is no time of {CLOCK} yet: mark again when it has come.")
        yield mark_now(directory, recording, simulated or now, text, tags, around=around)


@dataclass(frozen=True, kw_only=True)
class _Remove(Named, InStore, Quiet):
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
            pins = [pin["reason"] for one in chosen for pin in store.entry(one.id).pins]
            _confirm(chosen, pins)
        for one in chosen:
            with if_stopped(
                "A recording whose removal began is gone; the next command that opens the "
                "store removes the rest of it."
            ):
                store.remove(one.id)
            if not given.quiet:
                output.say(f"deleted {one.name}")


def _confirm(chosen: Sequence[RecordingSummary], pins: Sequence[str]) -> None:
    """Ask for consent, with what would be lost."""
    what = f"{listed(one.name for one in chosen)} for good"
    if pins:
        reasons = listed(filter(None, dict.fromkeys(pins)))
        what += f", with {output.counted(len(pins), 'pin')} ({reasons})"
    if not sys.stdin.isatty():
        raise UsageError(f"Deleting {what} needs --yes.")
    print_table(RECORDINGS, chosen)
    if not click.confirm(f"Delete {what}?", err=True):
        output.note("Nothing is deleted.")
        raise click.exceptions.Exit(1)
