"""`hybridlog export`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from hybridlog_storage.collection_names import collection_of
from hybridlog_storage.errors import DefinitionError, HybridlogError, UsageError

from hybridlog.cli import output
from hybridlog.cli.fetch import make_room, write

if TYPE_CHECKING:
    from hybridlog.reader import Query


def run(
    target: Path,
    form: str,
    store: Path | None,
    recordings: list[str] | None,
    topics: list[str] | None,
    between: tuple[str, str] | None,
    force: bool,  # noqa: FBT001
    mongo: str | None,
    quiet: bool,  # noqa: FBT001
) -> None:
    """Write everything that is chosen."""
    with output.opened(store, mongo) as opened:
        query = opened.topic(*topics) if topics else opened.all_topics()
        if recordings:
            query = query.in_recording(*recordings)
        if between is not None:
            query = query.between(*between)
        if form in {"mcap", "bag"}:
            make_room(target, force=force)
            write(query, form, target, quiet=quiet)
            if not quiet:
                output.note(
                    f"{target}: {query.counters.messages} messages, "
                    f"{output.size(target.stat().st_size)}"
                )
            return
        _tables(query, form, target, force=force, quiet=quiet)


def _tables(query: Query, form: str, directory: Path, *, force: bool, quiet: bool) -> None:
    """One file a topic; a topic that is no table is said and left out."""
    if directory.exists() and not directory.is_dir():
        raise UsageError(f"{directory} is a file; tables go into a directory, one a topic.")
    directory.mkdir(parents=True, exist_ok=True)
    left_out: list[HybridlogError] = []
    for topic in query.topics:
        one = query.only(topic)
        path = directory / f"{collection_of(topic)}.{form}"
        make_room(path, force=force)
        try:
            write(one, form, path, quiet=quiet)
        except DefinitionError as error:
            output.note(str(error))
            left_out.append(error)
            continue
        if not quiet:
            output.note(
                f"{path}: {one.counters.messages} messages, {output.size(path.stat().st_size)}"
            )
    if left_out and len(left_out) == len(query.topics):
        raise left_out[0]
