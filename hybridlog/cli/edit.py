"""`hybridlog rename`, `tag`, `untag`, `note`, `mark` and `rm`."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from hybridlog.cli import options, output
from hybridlog.cli.completion import complete_recording
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.query_options import named_or_chosen, recordings_of
from hybridlog.cli.signals import if_stopped
from hybridlog.wording import listed
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hybridlog.query.choice import Choice
    from hybridlog.store import Store
    from hybridlog_storage.summary import RecordingSummary


@click.command()
@options.one_recording
@click.argument("name", metavar="NAME", help="Its new name.")
@options.store
@options.quiet
def rename_command(*, recording: str, name: str, store: Path | None, quiet: bool) -> None:
    """Give a recording another name.

    Its directory is renamed as well; nothing else of the recording changes.
    """
    if not name.strip():
        raise UsageError("A recording needs a name: give one that is not empty.")
    with opened_store(store, None, quiet=quiet) as opened:
        entry = opened.rename(recording, name)
    if not quiet:
        output.say(f"renamed to {entry.label}")


@click.command()
@click.argument(
    "words",
    nargs=-1,
    metavar="[RECORDING] [KEY=VALUE]...",
    shell_complete=complete_recording,
    help="A recording, as for --recording, unless options choose; and tags to set. Without "
    "tags, show them.",
)
@options.choice
@options.store
@options.as_json
@options.quiet
def tag_command(
    *, words: tuple[str, ...], choice: Choice, store: Path | None, as_json: bool, quiet: bool
) -> None:
    """Set or show the tags of recordings."""
    with opened_store(store, None, quiet=quiet) as opened:
        chosen, pairs, is_one = named_or_chosen(opened, choice, words)
        tags = options.parse_tags(pairs)
        found = {
            one.label: opened.tag(one.id, **tags).tags if tags else one.tags
            for one in chosen.summaries
        }
    if as_json:
        output.print_json(next(iter(found.values())) if is_one else found)
    elif not quiet:
        for label, own in found.items():
            for key, value in sorted(own.items()):
                output.say(f"{key}={value}" if is_one else f"{label}: {key}={value}")


@click.command()
@click.argument(
    "words",
    nargs=-1,
    metavar="[RECORDING] KEY...",
    shell_complete=complete_recording,
    help="A recording, as for --recording, unless options choose; and keys of tags.",
)
@options.choice
@options.store
@options.quiet
def untag_command(
    *, words: tuple[str, ...], choice: Choice, store: Path | None, quiet: bool
) -> None:
    """Remove tags of recordings."""
    with opened_store(store, None, quiet=quiet) as opened:
        chosen, keys, is_one = named_or_chosen(opened, choice, words)
        if not keys:
            raise UsageError("Name the keys of the tags to remove.")
        for one in chosen.summaries:
            # Of several recordings, some may lack a tag.
            there = keys if is_one else [key for key in keys if key in one.tags]
            if there:
                opened.untag(one.id, *there)


@click.command()
@options.one_recording
@click.argument("text", metavar="TEXT", help="Text of the note.")
@options.store
@options.quiet
def note_command(*, recording: str, text: str, store: Path | None, quiet: bool) -> None:
    """Write a note about a recording; `info` shows it."""
    if not text.strip():
        raise UsageError("A note needs a text: give one that is not empty.")
    with opened_store(store, None, quiet=quiet) as opened:
        opened.note(recording, text)


@click.command()
@click.argument("text", metavar="TEXT", help="What happened.")
@click.option(
    "--set-tag", "tag", multiple=True, metavar="K=V", help="Add KEY=VALUE to it. Repeatable."
)
@options.running
@click.option(
    "--at",
    metavar="T",
    help="Mark a recording that has ended, at this time, written as for --between.",
)
@click.option("--until", metavar="T2", help="The mark lasts from --at to this time.")
@options.store
@options.quiet
def mark_command(
    *,
    text: str,
    tag: tuple[str, ...],
    recording: tuple[str, ...],
    at: str | None,
    until: str | None,
    store: Path | None,
    quiet: bool,
) -> None:
    """Set a mark that queries can use, now or at a past time.

    A mark is a message on /hybridlog/marks: `hybridlog fetch -t scan --where
    "/hybridlog/marks: text = 'gripper slipped'" --within 5s`.
    """
    tags = options.parse_tags(tag)
    if not text.strip():
        raise UsageError("A mark needs a text: say what happened.")
    if until is not None and at is None:
        raise UsageError("--until ends a mark that begins at a time: add --at.")
    if at is None:
        labels = _mark_running(text, tags, recording, store)
    elif len(recording) == 1:
        with opened_store(store, None, quiet=quiet) as opened:
            _check_begun(opened, recording[0], at)
            labels = iter([opened.mark(recording[0], at, text, tags, until=until).label])
    else:
        raise UsageError("A mark at a time needs one recording: name it with --recording.")
    for label in labels:
        if not quiet:
            output.note(f"Marked in {label}.")


def _check_begun(store: Store, recording: str, at: str) -> None:
    """Refuse a mark before its recording, of which it would become the beginning.

    Relative times count from there, and `--at 10` is a second of 1970.

    Raises:
        UsageError: The recording has not begun at this time.
    """
    from hybridlog.query.times import format_time, parse_time
    from hybridlog.record.losses import extent_of

    (entry,) = store.select([recording])
    start, end = extent_of(entry)
    time = parse_time(at, start=start, end=end)
    if start < end and time < start:
        raise UsageError(
            f"{at} is {format_time(time)}, and {entry.label} begins at {format_time(start)}: "
            "ten seconds from its beginning are +10s, ten before its end -10s."
        )


def _mark_running(
    text: str, tags: dict[str, str], recordings: tuple[str, ...], store: Path | None
) -> Iterator[str]:
    from hybridlog.live.control_server import choose, request
    from hybridlog.store import store_path

    path = store_path(store)
    for name in choose(path, recordings):
        yield str(request(path, name, "mark", text=text, tags=tags)["recording"])


_MAX_ROWS = 20


@click.command()
@options.only_recordings
@options.choice
@options.store
@click.option("--yes", "-y", is_flag=True, help="Do not ask.")
@options.mongo
def rm_command(*, choice: Choice, store: Path | None, yes: bool, mongo: str | None) -> None:
    """Delete recordings, payloads and index."""
    if choice.is_everything:
        raise UsageError(
            "Name the recordings to delete, or choose them: -r 'monday*', --tag robot=7. "
            "`hybridlog ls` lists all; -r '*' is all of them."
        )
    with opened_store(store, mongo) as opened:
        copies = [name for name in choice.name if name in opened.repairs.copies]
        rest = replace(choice, name=tuple(n for n in choice.name if n not in copies))
        chosen: Sequence[RecordingSummary] = ()
        if not copies or not rest.is_everything:
            chosen = recordings_of(opened, rest).summaries
        targets = {copy: copy for copy in copies} | {one.id: one.label for one in chosen}
        if not yes:
            _confirm(copies, chosen)
        for recording, label in targets.items():
            with if_stopped(
                "A recording whose removal began is gone; the next command that opens the "
                "store removes the rest of it."
            ):
                opened.remove(recording)
            output.say(f"deleted {label}")


def _confirm(copies: Sequence[str], chosen: Sequence[RecordingSummary]) -> None:
    """Ask for consent; several recordings are shown with what would be lost."""
    labels = [*copies, *(one.label for one in chosen)]
    several = len(labels) > 1
    names = f"{len(labels)} recordings ({listed(labels)})" if several else labels[0]
    if not sys.stdin.isatty():
        raise UsageError(f"Deleting {names} for good needs --yes.")
    if several:
        for copy in copies:
            output.note(f"  {copy}: a copy")
        for one in chosen[:_MAX_ROWS]:
            span = "" if one.span is None else f"{output.short_time(one.span[0])}, "
            output.note(
                f"  {one.label}: {span}{output.counted(one.messages, 'message')}, "
                f"{output.size(one.stored_bytes)}"
            )
        if len(chosen) > _MAX_ROWS:
            output.note(f"  and {len(chosen) - _MAX_ROWS} more")
        names = f"these {len(labels)} recordings"
    if not click.confirm(f"Delete {names} for good?", err=True):
        output.note("Nothing is deleted.")
        raise click.exceptions.Exit(1)
