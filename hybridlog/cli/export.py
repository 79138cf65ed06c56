"""`hybridlog export`."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from hybridlog.cli import output
from hybridlog.cli.asking import question
from hybridlog.cli.coverage import gaps
from hybridlog.cli.fetch import write
from hybridlog.cli.opening import opened
from hybridlog.cli.placing import check_room, replacing
from hybridlog.cli.stopping import Stopped
from hybridlog_storage.collection_names import collection_of
from hybridlog_storage.errors import DefinitionError, HybridlogError, TimeError, UsageError

if TYPE_CHECKING:
    from hybridlog.query.query import Query

_WHOLE = {"mcap", "bag"}


@dataclass(frozen=True, slots=True)
class Choices:
    """The options of the command, as typed."""

    store: Path | None
    recordings: list[str] | None
    topics: list[str] | None
    between: tuple[str, str] | None
    force: bool
    mongo: str | None
    quiet: bool


def run(target: Path, form: str | None, choices: Choices) -> None:
    """Write everything that is chosen."""
    form = form or _form(target)
    force, quiet = choices.force, choices.quiet
    if form in _WHOLE:
        check_room(target, form=form, force=force)
    with opened(choices.store, choices.mongo, quiet=quiet) as view:
        query = question(view, choices.topics, choices.recordings)
        if not query.topics:
            raise UsageError("Nothing was recorded, so there is nothing to export.")
        if choices.between is not None:
            query = query.between(*choices.between)
        if form in _WHOLE:
            _whole(query, form, target, force=force, quiet=quiet)
        else:
            _tables(query, form, target, force=force, quiet=quiet)
        if not quiet:
            chosen = [r for r in view.recordings() if r.id in query.recordings]
            for line in gaps(chosen, query.topics, choices.between):
                output.note(line)


def _form(target: Path) -> str:
    form = target.suffix.lower().lstrip(".")
    if form not in _WHOLE:
        raise UsageError(
            f"{target} does not say what to export: end it in .mcap or .bag, or name a directory "
            "for tables and add --format parquet or csv."
        )
    return form


def _whole(query: Query, form: str, target: Path, *, force: bool, quiet: bool) -> None:
    try:
        with replacing(target, form=form, force=force):
            write(query, form, target, quiet=quiet)
    except Stopped as stopped:
        stopped.consequence = f"{target} is not written."
        raise
    _tell(target, query, 0, quiet=quiet)


def _tables(query: Query, form: str, directory: Path, *, force: bool, quiet: bool) -> None:
    """One file a topic; a topic that is no table, or lies beside the range, is left out."""
    query.check_range()  # refuses a range that holds nothing of any topic
    new = not directory.exists()
    try:
        _make(directory)
        _write_tables(query, form, directory, force=force, quiet=quiet)
    finally:
        if new:
            with contextlib.suppress(OSError):  # it holds what was written
                directory.rmdir()


def _write_tables(query: Query, form: str, directory: Path, *, force: bool, quiet: bool) -> None:
    paths = {topic: directory / f"{collection_of(topic)}.{form}" for topic in query.topics}
    for path in paths.values():
        check_room(path, form=form, force=force)
    left_out: list[HybridlogError] = []
    try:
        for topic, path in paths.items():
            one = query.with_topic(topic)
            try:
                missing = write(one, form, path, quiet=quiet)
            except (DefinitionError, TimeError) as error:
                what = "" if isinstance(error, DefinitionError) else f"{topic}: "
                output.note(f"{what}{error}")
                left_out.append(error)
                continue
            _tell(path, one, missing, quiet=quiet)
    except Stopped as stopped:
        stopped.consequence = f"The files named above are whole, {path} is not written."
        raise
    if len(left_out) == len(paths):
        raise left_out[0]


def _make(directory: Path) -> None:
    """Make a directory for tables, if it is not there."""
    if directory.is_dir():
        return
    if directory.exists():
        raise UsageError(f"{directory} is a file; tables go into a directory, one a topic.")
    try:
        directory.mkdir(parents=True)
    except OSError as error:
        raise UsageError(f"{directory} cannot be made: {error.strerror}.") from error


def _tell(path: Path, query: Query, missing: int, *, quiet: bool) -> None:
    """A line a file; what is not in it is said in any case."""
    left_out = f" (left out: {output.unfit(missing)})" if missing else ""
    if missing or not quiet:
        output.note(
            f"{path}: {output.counted(query.counters.messages, 'message')}{left_out}, "
            f"{output.size(path.stat().st_size)}"
        )
