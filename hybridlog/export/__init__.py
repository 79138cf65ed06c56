"""Ways out of the store: files that other tools open.

`FORMATS` says what there is; `open_batch_writer`, `open_table_writer` and
`open_row_writer` make a writer by name. The modules behind them are loaded then.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    import pyarrow as pa

    from hybridlog.export.base import BatchWriter, RowWriter, TableWriter, Target

Kind = Literal["exact", "table", "rows"]


@dataclass(frozen=True, slots=True)
class Format:
    """A way out.

    Attributes:
        kind: `exact` formats carry payloads as they came and are fed with batches;
            `table` formats carry columns and are fed with Arrow tables; `rows` formats
            carry one object a message.
        suffix: Usual end of the file's name; empty for a directory.
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
"""Every format by the name that `--format` takes."""


def open_batch_writer(name: str, target: Target, *, profile: str = "") -> BatchWriter:
    """A writer of an `exact` format.

    Args:
        name: `mcap`, `bag` or `raw`.
        target: Path, or a binary stream such as standard output.
        profile: MCAP profile (`ros1`, `ros2` or empty); other formats have none.

    Raises:
        UsageError: No such format, or the target cannot be written.
    """
    if name == "mcap":
        from hybridlog.export.mcap import McapWriter

        return McapWriter(target, profile=profile)
    if name == "bag":
        from hybridlog.export.bag import BagWriter

        return BagWriter(target)
    if name == "raw":
        from hybridlog.export.raw import open_raw_writer

        return open_raw_writer(target)
    raise _no_such_format(name, "exact")


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
    """A writer of a `rows` format: `jsonl`.

    Raises:
        UsageError: No such format, or the target cannot be written.
    """
    if name == "jsonl":
        from hybridlog.export.jsonl import JsonlWriter

        return JsonlWriter(target)
    raise _no_such_format(name, "rows")


def _no_such_format(name: str, kind: Kind) -> UsageError:
    names = ", ".join(key for key, value in FORMATS.items() if value.kind == kind)
    return UsageError(f"{name!r} is no format for this: there are {names}")
