"""`hybridlog attachments`."""

from __future__ import annotations

import sys
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hybridlog.cli import options, output
from hybridlog.cli.answers import check_room, not_written
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.signals import if_stopped
from hybridlog.wording import listed
from hybridlog_storage.errors import TopicError, UsageError

if TYPE_CHECKING:
    from hybridlog.attachments import StoredAttachment


@click.command()
@options.one_recording
@click.argument(
    "name", required=False, metavar="[NAME]", help="An attachment, or a glob such as '*.yaml'."
)
@click.option(
    "--output",
    "-o",
    "target",
    type=options.PATH,
    metavar="FILE|DIR",
    help="Write to this file; several attachments into this directory.",
)
@options.store
@options.force
@options.mongo
@options.as_json
@options.quiet
def attachments_command(
    *,
    recording: str,
    name: str | None,
    target: Path | None,
    store: Path | None,
    force: bool,
    mongo: str | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """List the attachments of a recording's log, or fetch them.

    With NAME and without -o, the content goes to standard output.
    """
    with opened_store(store, mongo, quiet=as_json or quiet) as opened:
        found = _chosen(opened.attachments(recording), recording, name)
        if target is None and (name is None or as_json):
            _list(found, as_json=as_json)
        elif target is None:
            _print_content(found)
        elif name is None or len(found) > 1 or target.is_dir():
            _write_all(found, target, force=force, quiet=quiet)
        else:
            check_room(target, force=force)
            _write(found[0], target, quiet=quiet)


def _chosen(
    found: list[StoredAttachment], recording: str, name: str | None
) -> list[StoredAttachment]:
    if name is None:
        return found
    chosen = [each for each in found if each.name == name]
    chosen = chosen or [each for each in found if fnmatchcase(each.name, name)]
    if not chosen:
        names = listed(output.quoted(each.name) for each in found) or "none"
        raise TopicError(
            f"{recording} has no attachment {output.quoted(name)}. There are: {names}."
        )
    return chosen


def as_dict(attachment: StoredAttachment) -> dict[str, Any]:
    """An attachment as JSON."""
    return {
        "recording": attachment.recording,
        "name": attachment.name,
        "media_type": attachment.media_type,
        "bytes": attachment.size,
        "log_time_ns": attachment.log_time_ns,
        "create_time_ns": attachment.create_time_ns,
    }


def _list(found: list[StoredAttachment], *, as_json: bool) -> None:
    from hybridlog.query.times import format_time

    if as_json:
        output.print_json([as_dict(each) for each in found])
        return
    if not found:
        output.note("The log of this recording has no attachments.")
        return
    output.print_table(
        [("attachment", "left"), ("media type", "left"), ("size", "right"), ("log time", "left")],
        [
            (
                each.name,
                each.media_type,
                output.size(each.size),
                format_time(each.log_time_ns) if each.log_time_ns else "-",
            )
            for each in found
        ],
    )


def _print_content(found: list[StoredAttachment]) -> None:
    if len(found) > 1:
        raise UsageError(
            f"{len(found)} attachments have this name: -o DIR writes each of them into a file."
        )
    if sys.stdout.isatty() and not found[0].media_type.startswith("text/"):
        raise UsageError(f"{found[0].name} may be no text: name a file with -o.")
    for piece in found[0].pieces():
        sys.stdout.buffer.write(piece)
    sys.stdout.buffer.flush()


def _write_all(found: list[StoredAttachment], directory: Path, *, force: bool, quiet: bool) -> None:
    """Write each attachment into a directory, under a name made from its own."""
    from hybridlog.attachments import file_names

    paths = [directory / name for name in file_names(found)]
    for path in paths:
        check_room(path, force=force)
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{directory} cannot be made: {error.strerror}.") from error
    for attachment, path in zip(found, paths, strict=True):
        _write(attachment, path, quiet=quiet)


def _write(attachment: StoredAttachment, path: Path, *, quiet: bool) -> None:
    with if_stopped(partial(not_written, path)):
        attachment.save(path)
    if not quiet:
        output.note(f"{path}: {output.size(attachment.size)}")
