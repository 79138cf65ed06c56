"""Writers of files for other tools.

`FORMATS` lists the formats; `open_batch_writer`, `open_log_writer`, `open_table_writer` and
`open_row_writer` open a writer by name, and import its module then.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    import pyarrow as pa

    from hybridlog.export.base import BatchWriter, LogWriter, RowWriter, TableWriter, Target

Kind = Literal["exact", "table", "rows"]


@dataclass(frozen=True, slots=True)
class Format:
    """An output format.

    Attributes:
        kind: `exact` formats hold unchanged payloads and take batches; `table` formats hold
            columns and take Arrow tables; `rows` formats hold one object for each message.
        suffix: Usual suffix of the file; empty for a directory.
        help: One line for help texts.
    """

    kind: Kind
    suffix: str
    help: str


FORMATS: dict[str, Format] = {
    "jsonl": Format("rows", ".jsonl", "one JSON object a message"),
    "csv": Format("table", ".csv", "a table as text; arrays and structures as JSON"),
    "parquet": Format("table", ".parquet", "a table in zstd row groups"),
    "arrow": Format("table", ".arrow", "a table as an Arrow IPC file (Feather)"),
    "npz": Format("table", ".npz", "numpy arrays, one a column"),
    "mcap": Format("exact", ".mcap", "an MCAP file: every message as it came"),
    "bag": Format("exact", ".bag", "a ROS 1 bag: every ROS 1 message as it came"),
    "raw": Format("exact", "", "a directory with one file a payload"),
}
"""Every format by its name for `--format`."""
PICTURES = ("png", "jpg")
"""Formats for messages that are images: a directory with one file a message, or one file."""


def open_batch_writer(name: str, target: Target, *, profile: str = "") -> BatchWriter:
    """Open a writer of an `exact` format.

    Args:
        name: `mcap`, `bag` or `raw`.
        target: Path, or a binary stream such as standard output.
        profile: MCAP profile (`ros1`, `ros2` or empty); other formats have none.

    Raises:
        UsageError: No such format, or the target cannot be written.
    """
    if name == "raw":
        from hybridlog.export.raw import open_raw_writer

        return open_raw_writer(target)
    if name in {"mcap", "bag"}:
        return open_log_writer(name, target, profile=profile)
    raise _no_such_format(name, "exact")


def open_log_writer(name: str, target: Target, *, profile: str = "") -> LogWriter:
    """Open a writer of logs.

    Args:
        name: `mcap` or `bag`.
        target: Path, or a binary stream such as standard output.
        profile: MCAP profile (`ros1`, `ros2` or empty); bags have none.

    Raises:
        UsageError: The target cannot be written.
    """
    if name == "bag":
        from hybridlog.export.bag import BagWriter

        return BagWriter(target)
    from hybridlog.export.mcap import McapWriter

    return McapWriter(target, profile=profile)


def open_table_writer(name: str, target: Target, *, schema: pa.Schema | None = None) -> TableWriter:
    """A writer of a `table` format.

    Args:
        name: `csv`, `parquet`, `arrow` or `npz`.
        target: Path, or a binary stream such as standard output.
        schema: The columns, when they are known before; else they are learnt.

    Raises:
        UsageError: No such format, or the target cannot be written.
    """
    if name == "npz":
        from hybridlog.export.npz import NpzWriter

        return NpzWriter(target, schema=schema)
    from hybridlog.export.tables import ArrowWriter, CsvWriter, ParquetWriter

    if name == "csv":
        return CsvWriter(target, schema=schema)
    if name == "parquet":
        return ParquetWriter(target, schema=schema)
    if name == "arrow":
        return ArrowWriter(target, schema=schema)
    raise _no_such_format(name, "table")


def open_row_writer(name: str, target: Target) -> RowWriter:
    """Open a writer of a `rows` format: `jsonl`.

    Raises:
        UsageError: No such format, or the target cannot be written.
    """
    if name == "jsonl":
        from hybridlog.export.jsonl import JsonlWriter

        return JsonlWriter(target)
    raise _no_such_format(name, "rows")


def _no_such_format(name: str, kind: Kind) -> UsageError:
    names = ", ".join(key for key, value in FORMATS.items() if value.kind == kind)
    return UsageError(f"{name!r} is not a format for this command; use {names}")
