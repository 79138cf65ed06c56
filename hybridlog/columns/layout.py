"""Names of files of columns: folders, files, columns and the metadata of a file.

```
tables/<type>~<shape8>/shared-<time>.parquet     several recordings
tables/<type>~<shape8>/<id>-<number>.parquet     a long topic of one recording
tables.part/r<id>/                               unfinished files
recordings/<id>/000002.rows.parquet              what is left of the messages of a log
```

A folder of `tables` has the rows of all ended recordings of one message type. All of its
files have the same schema, of which `shape8` is a hash.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from msgspec import Struct

if TYPE_CHECKING:
    from hybridlog_storage.catalog import RecordingEntry

TABLES: Final = "tables"
"""Folder of the store that holds finished tables."""
PARTS: Final = "tables.part"
"""Folder of the store that holds unfinished tables."""
SUFFIX: Final = ".parquet"
SHARED: Final = "shared-"
"""Beginning of the names of files that recordings share."""
OWN_COLUMNS: Final = frozenset(
    {
        "recording",
        "topic",
        "log_time",
        "t",
        "seq",
        "pub",
        "stamp",
        "channel",
        "state",
        "error",
        "ref",
    }
)
"""Columns that every table has besides the fields of the messages, which have other names."""
ORIGINAL: Final = b"hybridlog.name"
"""Metadata of a column: the name of its field, if it differs."""
SUMMARY: Final = b"hybridlog.summary"
"""Metadata of a column: the name of the array whose summaries it has."""
EMPTY: Final = b"hybridlog.empty"
"""Metadata of a column of booleans, or of arrays of them: its messages have no fields."""
OWN: Final = b"hybridlog.own"
"""Metadata of a column that is none of a field, besides `OWN_COLUMNS`."""
POINTS: Final = "points"
"""Column of the points of clouds, a list for each of their fields."""
ABOUT: Final = b"hybridlog"
"""Metadata of a file: its sections as JSON."""
_ODD: Final = re.compile(r"[^A-Za-z0-9_]")


def parts_folder(root: Path, recording: str) -> Path:
    """Folder of a recording's unfinished tables."""
    return root / PARTS / f"r{recording}"


def type_prefix(type_name: str) -> str:
    """Beginning of the names of the folders of a message type."""
    return f"{_ODD.sub('_', type_name)[:100] or 'untyped'}~"


def shape_folder(type_name: str, schema: Any) -> str:
    """Folder of a message type, whose name may be empty, by the Arrow schema of its tables."""
    text = schema.to_string(truncate_metadata=False, show_schema_metadata=False)
    return type_prefix(type_name) + hashlib.sha256(text.encode()).hexdigest()[:8]


def topics_of(entry: RecordingEntry) -> set[str]:
    """Topics of a recording that have messages."""
    return {c.topic for c in entry.channels if c.stats.messages}


def column_names(
    names: Iterable[str], reserved: Collection[str] = OWN_COLUMNS
) -> Iterator[tuple[str, str]]:
    """Fields of a message, and the name of the column for each.

    A field with a reserved name gets a trailing `_`. A field that differs from an earlier one
    only in case gets a number, since DuckDB ignores case. No name is reserved inside a nested
    message.
    """
    names = list(names)
    ours, lower = {one.casefold() for one in reserved}, {one.casefold() for one in names}
    taken = {*ours}
    for name in names:
        others = chain([f"{name}_"] * (name.casefold() in ours), (f"{name}_{n}" for n in count(2)))
        fresh = (one for one in others if one.casefold() not in lower)
        column = next(one for one in chain([name], fresh) if one.casefold() not in taken)
        taken.add(column.casefold())
        yield name, column


class Section(Struct, frozen=True):
    """Rows of one topic of one recording in a file.

    `segments` has the digest of each segment with rows in it, by its number as text. So many rows
    are `unreadable`. With `arrays` these are in full, but for bytes, else up to a limit.
    """

    id: str
    topic: str
    segments: Mapping[str, str]
    rows: int
    unreadable: int = 0
    arrays: bool = False
