"""Names of tables: folders, files, columns and the metadata of a file.

```
tables/recording=r<id>/topic=<collection>/<schema8>-<segment>.parquet
tables/recording=r<id>/small/<type>~<schema8>.parquet
tables.part/r<id>/      unfinished files; only finished ones get a name in `tables`
```

The folders are hive partitions. The id has a leading letter, because readers that infer
types read `1e3` and `1000` as the same number. The schema is in the name of a file, which
gives all files of one glob the same type.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from hybridlog_storage.catalog import schema_hash
from hybridlog_storage.collection_names import collection_of
from hybridlog_storage.errors import StoreError
from hybridlog_storage.messages import ORIGINAL_ENCODING, REDUCED

if TYPE_CHECKING:
    from hybridlog_storage.messages import Channel

TABLES: Final = "tables"
"""Folder of the store that holds finished tables."""
PARTS: Final = "tables.part"
"""Folder of the store that holds unfinished tables."""
SMALL: Final = "small"
"""Folder of a recording's tables that holds topics with few rows."""
SUFFIX: Final = ".parquet"
NO_TABLE: Final = "no-table"
"""File in the folder of a topic that marks that no table can be made."""
OWN_FILE_ROWS: Final = 1000
"""Number of rows from which a topic has its own file."""
IN_TABLES: Final = 2
"""Depth of a recording's folder below the store."""
IN_TOPIC: Final = 4
"""Depth of a file of tables below the store."""
OWN_COLUMNS: Final = (
    "log_time",
    "t",
    "seq",
    "pub",
    "stamp",
    "channel",
    "state",
    "error",
    "ref",
)
"""Columns that every table has in addition to the fields of the messages."""
TOPIC_COLUMN: Final = "topic"
"""Column of a table of several topics."""
STATES: Final = ("whole", "reduced", "unreadable", "expired")
"""Values of the column `state`."""
ORIGINAL: Final = b"hybridlog.name"
"""Metadata of a column: the name of its field, if it differs."""
ABOUT: Final = b"hybridlog"
"""Metadata of a file: an `About` as JSON."""
VERSION: Final = 1
RESERVED: Final = frozenset({*OWN_COLUMNS, TOPIC_COLUMN, "recording"})
"""Names that no column of a field has."""
_ODD: Final = re.compile(r"[^A-Za-z0-9_]")


def recording_folder(root: Path, recording: str) -> Path:
    """Folder of a recording's tables.

    Args:
        root: The store.
        recording: Id of the recording.
    """
    return root / TABLES / f"recording=r{recording}"


def parts_folder(root: Path, recording: str) -> Path:
    """Folder of a recording's unfinished tables."""
    return root / PARTS / f"r{recording}"


def topic_folder(topic: str) -> str:
    """Name of the folder of a topic's tables."""
    return f"topic={collection_of(topic)}"


def table_schema(message_encoding: str, schema: str | None, metadata: Mapping[str, str]) -> str:
    """Hash of everything that determines the columns of a channel: 64 hexadecimal digits.

    Args:
        message_encoding: Encoding of the channel.
        schema: Hash of its schema, if any.
        metadata: Metadata of the channel; a reduced one names its original encoding there.
    """
    if message_encoding == REDUCED:
        message_encoding = metadata.get(ORIGINAL_ENCODING, "")
    return hashlib.sha256(f"{message_encoding}:{schema or ''}".encode()).hexdigest()


def table_schema_of(channel: Channel) -> str:
    """The hash of `table_schema` for a channel."""
    schema = schema_hash(channel.schema) if channel.schema is not None else None
    return table_schema(channel.message_encoding, schema, channel.metadata)


def topic_file(schema: str, segment: int, part: int = 0) -> str:
    """Name of a file of one topic.

    Args:
        schema: See `table_schema`.
        segment: The last segment with messages in it.
        part: Number of such files so far: columns of one file have one type.
    """
    return f"{schema[:8]}-{segment:06d}{f'-{part}' if part else ''}{SUFFIX}"


def small_file(type_name: str, schema: str) -> str:
    """Name of a file of several topics of one type."""
    return f"{_ODD.sub('_', type_name)[:100] or 'untyped'}~{schema[:8]}{SUFFIX}"


def column_names(
    names: Iterable[str], reserved: Collection[str] = RESERVED
) -> Iterator[tuple[str, str]]:
    """Fields of a message, and the name of the column for each.

    A field with a reserved name gets a trailing `_`. A field that differs from an earlier one
    only in case gets a number, since DuckDB ignores case.

    Args:
        names: Names of the fields, in order.
        reserved: Reserved names; none inside a nested message.
    """
    names = list(names)
    taken = {name.casefold() for name in reserved}
    lower = [name.casefold() for name in names]
    for place, name in enumerate(names):
        column, number = name, 2
        if name.casefold() in taken:
            is_ours = name.casefold() in reserved
            column = f"{name}_" if is_ours else f"{name}_{number}"
            while column.casefold() in taken or column.casefold() in lower[place + 1 :]:
                column, number = f"{name}_{number}", number + 1
        taken.add(column.casefold())
        yield name, column


@dataclass(frozen=True, slots=True)
class About:
    """The description of a file of tables, stored in the file itself.

    Attributes:
        recording: Id of the recording.
        schema: See `table_schema`.
        type: Name of the type of the messages, possibly empty.
        segments: Digest of each segment that has rows in the file, by its number as text.
        topics: Rows of each topic, in the order of the file.
        bounds: For each row group: its rows, then log time and arrival number of its first and
            last row. The keys are zeros in a file of several topics.
        unreadable: Rows without fields, because their messages do not fit their definition.
        reduced: Rows without fields, because their messages were reduced under pressure.
        body: Bytes before the footer.
        checksums: CRC-32 of each block of the body, 8 hexadecimal digits each.
        version: Version of the format.
        payloads: What a file of payloads needs besides; empty in a table.
    """

    recording: str
    schema: str
    type: str
    segments: Mapping[str, str]
    topics: Mapping[str, int]
    bounds: tuple[tuple[int, int, int, int, int], ...]
    unreadable: int = 0
    reduced: int = 0
    body: int = 0
    checksums: str = field(default="", repr=False)
    version: int = VERSION
    payloads: Mapping[str, Any] = field(default_factory=dict, repr=False)

    @property
    def rows(self) -> int:
        """Rows of all topics."""
        return sum(self.topics.values())

    def to_json(self) -> str:
        """The description as JSON text."""
        return json.dumps(asdict(self), separators=(",", ":"))

    @classmethod
    def from_json(cls, text: bytes) -> About:
        """The description from its JSON text.

        Raises:
            StoreError: the text is invalid, or of another version.
        """
        try:
            values: dict[str, Any] = json.loads(text)
            if values["version"] != VERSION:
                raise StoreError("the table has another version")
            values["bounds"] = tuple(tuple(map(int, bound)) for bound in values["bounds"])
            about = cls(**values)
            is_sound = (
                all(len(bound) == 5 for bound in about.bounds)
                and sum(bound[0] for bound in about.bounds) == about.rows
            )
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise StoreError("the description of the table cannot be read") from error
        if not is_sound:
            raise StoreError("the description of the table contradicts itself")
        return about
