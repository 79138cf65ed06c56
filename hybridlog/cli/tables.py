"""`hybridlog tables`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from glob import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hybridlog.cli import output
from hybridlog.cli.binder import argument, command
from hybridlog.cli.completion import complete_topic
from hybridlog.cli.options import AsJson, Choosing, InStore, query_of
from hybridlog_storage.errors import TopicError

if TYPE_CHECKING:
    from collections.abc import Collection

    from hybridlog.query.question import RecordedChannel
    from hybridlog.store import Store


@dataclass(frozen=True, kw_only=True)
class _Given(Choosing, InStore, AsJson):
    topic: str = argument(
        "Full name, or an unambiguous short one (scan).", "TOPIC", shell_complete=complete_topic
    )


@command(_Given)
def tables_command(given: _Given) -> None:
    """Show a topic's Parquet files, and SQL for DuckDB."""
    from hybridlog.snapshot import UNFINISHED

    with given.opened() as store:
        channels = query_of(store, [given.topic], given.choice).channels()
        ended = [one for one in channels if one.recording.status not in UNFINISHED]
        for one in ended:  # made again where they are missing
            store.session.table(one.recording, one.channel.topic)
        store.mend(math.inf)
        store.session.write_recordings_file()
        found = _found(store, ended)
        others = len({one.recording.id for one in channels}) - len(
            {one.recording.id for one in ended}
        )
    if given.as_json:
        output.print_json(found)
        return
    if not found:
        raise TopicError(f"No chosen recording that has ended has a table of {given.topic}.")
    for item in found:
        for name in item["files"]:
            output.say(name)
        output.say()
        output.say(f"{item['statement']};")
        output.say()
    if others:
        left = output.counted(others, "unfinished recording")
        output.note(f"Without {left}: rows are added when a recording ends.")


def _found(store: Store, channels: Collection[RecordedChannel]) -> list[dict[str, Any]]:
    """Folders with rows of a topic in some recordings: files, rows, statement."""
    from hybridlog.columns.folders import files_of
    from hybridlog.columns.layout import type_prefix

    topics = {one.channel.topic for one in channels}
    recordings = {one.recording.id for one in channels}
    schemas = [one.channel.schema for one in channels]
    prefixes = {type_prefix("" if schema is None else schema.name) for schema in schemas}
    (name,) = topics or {""}
    folders: dict[Path, dict[str, Any]] = {}
    others: set[Path] = set()
    for file in files_of(store.directory.path, prefixes) if prefixes else ():
        sections = [one for one in file.about.recordings if name in one.topics]
        rows = sum(one.topics[name].rows for one in sections if one.id in recordings)
        if not all(one.id in recordings for one in sections):
            others.add(file.path.parent)
        if rows:
            folder = file.path.parent
            found = folders.setdefault(folder, {"folder": str(folder), "rows": 0, "files": []})
            found["rows"] += rows
            found["files"].append(str(file.path))
    chosen = f" and recording in ({', '.join(map(_quoted, sorted(recordings)))})"
    for folder, found in folders.items():
        files = _quoted(f"{escape(str(folder))}/*.parquet")
        # The only texts in it are quoted, and nothing is run here.
        statement = f"select * from {files} where topic = {_quoted(name)}"  # noqa: S608
        found["statement"] = statement + (chosen if folder in others else "")
    return list(folders.values())


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"
