"""`hybridlog export`, and answers that are split over several files."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from hybridlog.cli import output
from hybridlog.cli.answers import (
    Destination,
    check_room,
    form_of,
    latched,
    not_written,
    write_answer,
)
from hybridlog.cli.binder import argument, command, option
from hybridlog.cli.lerobot import LEROBOT, Training, export_set
from hybridlog.cli.options import Slices, Topics, parse_fields
from hybridlog.cli.signals import if_stopped
from hybridlog.formats import OUTPUTS, formats_of, is_directory, suffixes_of
from hybridlog.formats.slices import Front
from hybridlog_storage.disk.unfinished import undone
from hybridlog_storage.errors import (
    DefinitionError,
    HybridlogError,
    PayloadError,
    TimeError,
    UsageError,
)

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog.attachments import Extras
    from hybridlog.query.query import Query

_LOGS = formats_of("log")
_FILES = formats_of("table", "lines", "video")
"""Formats with a file a topic."""


@dataclass(frozen=True, kw_only=True)
class _Given(Topics, Slices, Training):
    target: Path = argument(
        "File (mcap, bag) or directory (rosbag2, lerobot, mp4, tables).", "OUTPUT"
    )
    form: str | None = option(
        f"Without: by the suffix ({', '.join(suffixes_of(_LOGS))}). One of "
        f"{', '.join([*_LOGS, LEROBOT, *_FILES])}.",
        "FORMAT",
        name="--format",
        short="-F",
        type=click.Choice([*_LOGS, LEROBOT, *_FILES]),
    )
    no_attachments: bool = option("Leave out attachments; they are in MCAP files only.")


@command(_Given)
def export_command(given: _Given) -> None:
    """Export whole recordings; tables get one file a topic.

    `lerobot` makes a training set for robot learning.
    """
    target, force, quiet, split = given.target, given.force, given.quiet, given.split
    if str(target) == "-":
        raise UsageError("export writes files; for a pipe: `hybridlog fetch '**' -F mcap -o -`.")
    form = given.form or form_of(target, suffixes_of(_LOGS))
    front = Front(latched=not given.no_latched, original_times=given.original_times)
    settings = given.settings(form)
    if form in _LOGS and split is None:
        check_room(target, force=force, is_directory=is_directory(form, target))
    with given.opened(snapshot=True) as store:
        query = given.query(store)
        if not query.topics:
            raise UsageError(store.session.when_empty)
        if given.tags is not None:
            query = query.tags(*parse_fields(given.tags, "--tags"))
        if form == LEROBOT:
            if split is not None:
                raise UsageError("lerobot has --episodes-by in place of --split-by.")
            export_set(store, query, target, given, force=force, quiet=quiet)
            return
        parts: Iterable[tuple[Path, Query]] = [(target, query)]
        if split is not None:
            folder = is_directory(form, target) if form in _LOGS else None
            parts = pieces(query, split, target, force=force, is_directory=folder)
        for path, one in parts:
            to = Destination(form=form, path=path, force=force, quiet=quiet, settings=settings)
            if form in _LOGS:
                from hybridlog.attachments import extras_of

                extras = extras_of(one.session, one.question)
                if given.no_attachments:
                    extras = extras._replace(attachments=[], left_out=0)
                _write_file(one, to, path, front, extras)
            else:
                _write_directory(one, to, path, front)
            if not quiet:
                output.notes(one.remarks(is_empty=None if form in _LOGS else False))


def _write_file(query: Query, to: Destination, path: Path, front: Front, extras: Extras) -> None:
    with to.opened() as target:
        write_answer(
            query,
            to.form,
            target,
            front=front,
            extras=extras,
            quiet=to.quiet,
            settings=to.settings,
        )
    has_extras = to.form == "mcap" or (to.form, to.settings.get("storage")) == ("rosbag2", "mcap")
    counts = (len(extras.attachments), "attachment"), (len(extras.metadata), "metadata record")
    beside = "".join(f", {output.counted(count, what)}" for count, what in counts if count)
    print_written(path, query, beside=beside if has_extras else "", quiet=to.quiet)
    if beside and not has_extras:
        output.note(f"A bag cannot hold {beside[2:]} of the log; an MCAP file can.")
    if extras.left_out and has_extras:
        left_out = output.counted(extras.left_out, "attachment")
        output.note(f"{left_out} from behind the time range: left out.")


def _write_directory(query: Query, to: Destination, directory: Path, front: Front) -> None:
    """Write one file a topic, except topics that do not fit or have no message in the range."""
    from hybridlog.query.ranges import RangeResolver

    RangeResolver(query.session, query.question).resolve()  # refuses a range without any message
    is_new = not directory.is_dir()
    with undone(partial(_remove_empty, directory)) if is_new else contextlib.nullcontext():
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"{directory} cannot be made: {error.strerror}.") from error
        _write_files(query, to, directory, front)


def _remove_empty(directory: Path) -> None:
    with contextlib.suppress(OSError):  # files were written into it
        directory.rmdir()


def _write_files(query: Query, to: Destination, directory: Path, front: Front) -> None:
    from hybridlog.query.asked import narrowed
    from hybridlog_storage.mongo.collection_names import collection_of

    suffix, topics = OUTPUTS[to.form].suffixes[0], [*query.topics]
    if OUTPUTS[to.form].content == "video":
        topics = _image_topics(query)
    paths = {topic: directory / f"{collection_of(topic)}{suffix}" for topic in topics}
    for path in paths.values():
        check_room(path, force=to.force)
    left_out: list[HybridlogError] = []
    for topic, path in paths.items():
        one = narrowed(query, topic)
        try:
            with if_stopped(lambda: f"The files named above are whole. {not_written(path)}"):  # noqa: B023 - of this round
                missing = write_answer(one, to.form, path, front=front, quiet=to.quiet)
        except (DefinitionError, PayloadError, TimeError, UsageError) as error:
            is_named = isinstance(error, DefinitionError) or topic in str(error)
            output.note(f"{'' if is_named else f'{topic}: '}{error}")
            left_out.append(error)
            continue
        print_written(path, one, missing, quiet=to.quiet)
        query.counters.add(one.counters)
    if len(left_out) == len(paths):
        raise left_out[0]


def _image_topics(query: Query) -> list[str]:
    """The topics of images and of video among those of a query."""
    from hybridlog.arrays.message_arrays import IMAGES, plain_type

    entries = map(query.session.entry_of, query.summaries())
    found = {c.topic for entry in entries for c in entry.channels if plain_type(c.type) in IMAGES}
    if not found.intersection(query.topics):
        raise UsageError("There is no topic of images or of video.")
    return [topic for topic in query.topics if topic in found]


def print_written(
    path: Path, query: Query, missing: int = 0, beside: str = "", *, quiet: bool
) -> None:
    """Print a line about a file; --quiet leaves it out, unless messages are missing."""
    left_out = f" (left out: {output.unfit(missing)})" if missing else ""
    if missing or not quiet:
        written = query.counters.messages - query.counters.reduced - missing
        files = path.iterdir() if path.is_dir() else [path]
        output.note(
            f"{path}: {output.counted(written, 'message')}{left_out}"
            f"{latched(query.counters)}{beside}, "
            f"{output.size(sum(one.stat().st_size for one in files))}"
        )


def pieces(
    query: Query, how: str, target: Path, *, force: bool, is_directory: bool | None
) -> Iterator[tuple[Path, Query]]:
    """The parts of an answer that have messages, and where to write each; says which have none.

    Places are checked here unless `is_directory` is None: then by those who write there.
    """
    from hybridlog.query.pieces import pieces as split

    found: list[tuple[Path, Query]] = []
    for piece in split(query, how):
        count = 0
        with contextlib.suppress(TimeError):  # the range is outside
            count = piece.query.count()
        if count:
            path = target.with_name(f"{target.stem}-{piece.name}{target.suffix}")
            found.append((path, piece.query))
        else:
            output.note(f"{piece.name}: no messages, so no file.")
    if not found:
        output.note("No messages, so no file.")
    for path, _ in found if is_directory is not None else ():
        check_room(path, force=force, is_directory=bool(is_directory))
    yield from found
