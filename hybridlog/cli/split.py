"""Splits an answer over several files: `--split-by recording|mark|PREDICATE`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from hybridlog.cli import output
from hybridlog.cli.answers import check_room
from hybridlog_storage.errors import TimeError

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog.query.pieces import Piece
    from hybridlog.query.query import Query


def pieces(
    query: Query, how: str, target: Path, *, force: bool, is_directory: bool | None
) -> Iterator[tuple[Path, Query]]:
    """The parts of an answer that have messages, and where to write each; says which have none.

    Args:
        query: The whole question.
        how: `recording`, `mark`, or a predicate, with `TOPIC: ` in front or about the one topic.
        target: The output.
        force: Overwrite files.
        is_directory: Each part is a directory with a file a message; None if the writer checks
            its files.

    Raises:
        UsageError: A predicate of no topic, or a file exists.
        WhereError: It cannot be parsed, or does not fit the fields.
        TopicError: There is no such topic.
    """
    from hybridlog.query.pieces import pieces as split

    there = [*split(query, how)]
    if not there and how != "recording":
        output.note("No mark." if how == "mark" else "No interval.")
    found = [piece for piece in there if _has_messages(piece)]
    if not found:
        output.note("No messages, so no file.")
    paths = [target.with_name(f"{target.stem}-{one.name}{target.suffix}") for one in found]
    if is_directory is not None:
        for path in paths:
            check_room(path, force=force, is_directory=is_directory)
    yield from zip(paths, (piece.query for piece in found), strict=True)


def _has_messages(piece: Piece) -> bool:
    try:
        count = piece.query.count()
    except TimeError:  # the range is outside
        count = 0
    if not count:
        output.note(f"{piece.name}: no messages, so no file.")
    return count > 0
