"""`hybridlog open`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import click

from hybridlog.cli import options, output
from hybridlog.cli.answers import check_room, not_written, print_remarks
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.query_options import asked
from hybridlog.cli.signals import if_stopped
from hybridlog_storage.errors import HybridlogError, MissingDependencyError

if TYPE_CHECKING:
    from hybridlog.query.choice import Choice
    from hybridlog.query.query import Query

_PLAY = "`hybridlog serve` plays to the one in the browser"


class _Viewer(NamedTuple):
    """A viewer: its programs, one of which is enough, their options, and where to get one."""

    programs: Sequence[str]
    options: Sequence[str]
    cure: str


_VIEWERS: Final = {
    "foxglove": _Viewer(
        ("foxglove-studio", "lichtblick"), (), f"get it from https://foxglove.dev/download; {_PLAY}"
    ),
    "lichtblick": _Viewer(
        ("lichtblick",),
        (),
        "get it from https://github.com/lichtblick-suite/lichtblick/releases",
    ),
    # It would listen on all interfaces for other programs.
    "rerun": _Viewer(("rerun",), ("--bind", "127.0.0.1"), "pip install rerun-sdk"),
}


@click.command()
@click.argument(
    "viewer",
    type=click.Choice(sorted(_VIEWERS)),
    metavar="VIEWER",
    help="foxglove, lichtblick or rerun. Where only Lichtblick is installed, foxglove is that.",
)
@options.only_recordings
@options.only_topics
@options.store
@options.between
@options.where
@options.choice
@click.option(
    "--output",
    "-o",
    "path",
    type=options.PATH,
    metavar="FILE",
    help="Write the slice to this MCAP file; without, into the user's cache.",
)
@options.strict
@options.force
@options.mongo
@options.quiet
def open_command(
    *,
    viewer: str,
    choice: Choice,
    topic: tuple[str, ...],
    store: Path | None,
    between: tuple[str, str] | None,
    where: tuple[str, ...],
    path: Path | None,
    strict: bool,
    force: bool,
    mongo: str | None,
    quiet: bool,
) -> None:
    """Open a slice in Foxglove, Lichtblick or Rerun.

    The program has to be installed. The slice is written as an MCAP file first. The command
    ends when the program does.
    """
    import subprocess

    from hybridlog.cli.answers import write_answer
    from hybridlog.formats.slices import SliceCache

    program = _find(viewer)
    if path is not None:
        check_room(path, force=force)
    with opened_store(store, mongo, quiet=quiet) as opened:
        query = asked(opened, topic, choice, between=between, where=where, strict=strict)

        def write(query: Query, path: Path) -> None:
            write_answer(query, "mcap", path, extras=query.extras(), quiet=quiet)

        if path is None:
            ids = query.recordings
            name = opened.entry(ids[0]).label if len(ids) == 1 else "slice"
            path = SliceCache().get(query, name, write)
        else:
            with if_stopped(partial(not_written, path)):
                write(query, path)
        if not quiet:
            print_remarks(query, topic, is_empty=False)
            output.note(f"{path}: {output.size(path.stat().st_size)}, opened with {program}")
    ended = subprocess.run(  # noqa: S603
        [program, *_VIEWERS[viewer].options, path.absolute()], check=False
    )
    if ended.returncode:
        raise HybridlogError(f"{program} ended with exit code {ended.returncode}.")


def _find(viewer: str) -> str:
    """The path of the program.

    Raises:
        MissingDependencyError: It is not installed.
    """
    import shutil

    programs, _, cure = _VIEWERS[viewer]
    for name in programs:
        found = shutil.which(name)
        if found is not None:
            return found
    names = " or ".join(programs)
    raise MissingDependencyError(f"There is no program {names} on the PATH: {cure}.")
