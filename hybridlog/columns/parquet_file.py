"""Writes Parquet files whose pages have Parquet's checksums, and whose footer has one of its own.

The footer's is the 4 bytes in front of it, a CRC-32. Other readers ignore both.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq

from hybridlog.columns.column_file import leaves
from hybridlog.columns.layout import ABOUT, About, Section
from hybridlog.schema.arrow_types import is_bytes
from hybridlog_storage.checksum import crc32
from hybridlog_storage.disk import files

if TYPE_CHECKING:
    from hybridlog_storage.messages import Buffer

_WRITTEN: Final = 1 << 20  # bytes buffered before a write
_RUNNING: Final = frozenset({"t", "log_time", "seq", "pub", "stamp", "ref.chunk", "ref.off"})


class ParquetFileWriter:
    """Writes one file of a table, in the folder of a recording's unfinished tables.

    No reader of Parquet looks at the bytes of `front`.
    """

    def __init__(
        self, path: Path, schema: pa.Schema, *, level: int = 1, front: bytes = b""
    ) -> None:
        self.path = path
        self._sink = _Sink(path)
        kinds = {leaf.path: leaf.kind for leaf in leaves(schema)}
        running = [  # adjacent values differ by little
            path
            for path, kind in kinds.items()
            if path in _RUNNING
            or pa.types.is_timestamp(kind)
            or (path.endswith(".seq") and pa.types.is_integer(kind))
        ]
        # DuckDB answers wrongly from statistics of floats with NaN among them.
        ordered = [
            path
            for path, kind in kinds.items()
            if not (is_bytes(kind) or pa.types.is_floating(kind))
        ]
        repeating = [path for path in ordered if path not in running and kinds[path] != pa.bool_()]
        try:
            self._file = pa.PythonFile(self._sink, mode="w")
            self._writer = pq.ParquetWriter(
                self._file,
                schema,
                compression="zstd",
                compression_level=level,
                use_dictionary=repeating,
                column_encoding=dict.fromkeys(running, "DELTA_BINARY_PACKED"),
                write_statistics=ordered,
                write_page_checksum=True,
            )
            self._file.write(front)
        except BaseException:
            self.discard()
            raise

    def write(self, table: pa.Table) -> None:
        """Write a row group."""
        self._writer.write_table(table, row_group_size=max(table.num_rows, 1))

    def close(self, sections: Sequence[Section], *, sync: bool = False) -> None:
        """Finish the file, with its sections in order."""
        try:
            self._sink.end_body()
            about = msgspec.json.encode(About(sections))
            self._writer.add_key_value_metadata({ABOUT.decode(): about.decode()})
            self._writer.close()
            self._sink.finish(sync=sync)
        except BaseException:
            self.discard()
            raise

    def discard(self) -> None:
        """Delete the unfinished file."""
        self._sink.abandon()
        with suppress(OSError):
            files.unlink(self.path)


class _Sink:
    """Receives Parquet's bytes: the body goes to the disk, the footer to memory until sealed."""

    def __init__(self, path: Path) -> None:
        self.closed = False
        self._fd = files.open_file(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
        self._waiting = bytearray()
        self._most = _WRITTEN
        self._position = 0

    def write(self, data: Buffer) -> int:
        """Write bytes."""
        data = memoryview(data).cast("B")
        if self._fd >= 0:  # pyarrow closes its writer when it is collected
            self._position += len(data)
            self._waiting += data
            if len(self._waiting) >= self._most:
                self._flush()
        return len(data)

    def end_body(self) -> None:
        """Begin the footer."""
        self._flush()
        self._most = sys.maxsize

    def finish(self, *, sync: bool) -> None:
        """Seal the footer, and write all remaining bytes."""
        self._waiting[:0] = crc32(self._waiting).to_bytes(4, "little")
        self._flush()
        if sync:
            files.system.sync(self._fd)
        self.abandon()

    def abandon(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
        self._fd = -1

    def _flush(self) -> None:
        files.write_all(self._fd, [bytes(self._waiting)])
        self._waiting.clear()

    def tell(self) -> int:
        return self._position

    def close(self) -> None:
        """Do nothing: the footer follows."""
