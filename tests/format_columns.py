"""Rows of messages whose log is gone, read by the section about them in `docs/format.md` alone.

`pyarrow` reads Parquet; what they mean is from the page.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from blake3 import blake3


class WrongColumnsError(Exception):
    """A file is missing, or not as the specification says."""


def demand(condition: bool, what: str) -> None:
    if not condition:
        raise WrongColumnsError(what)


class Columns:
    """The files of rows of one log.

    Args:
        folder: Folder of the recording.
        listed: The files, as the manifest lists them.
        recording: Id of the recording.
    """

    def __init__(self, folder: Path, listed: Sequence[Mapping[str, Any]], recording: str) -> None:
        self._folder = folder
        self._listed = listed
        self._recording = recording

    def left(self, chunk: int) -> list[dict[str, Any]]:
        """The rows of a chunk, in the order of its messages."""
        found: list[dict[str, Any]] = []
        for listed in self._listed:
            rows = self._checked(self._folder / listed["name"], listed).to_pylist()
            found += [row for row in rows if row["ref"]["chunk"] == chunk]
        return sorted(found, key=lambda row: row["ref"]["off"])

    def _checked(self, path: Path, listed: Mapping[str, Any]) -> pa.Table:
        """The rows of a file whose checksums are right."""
        demand(path.is_file(), "a file of rows is missing")
        data = path.read_bytes()
        demand(len(data) == listed["bytes"] and data[-4:] == b"PAR1", "the size of a file")
        begin = len(data) - 8 - int.from_bytes(data[-8:-4], "little")
        footer = data[begin:]
        demand(blake3(data).hexdigest() == listed["digest"], "the digest")
        seal = int.from_bytes(data[begin - 4 : begin], "little")
        demand(seal == zlib.crc32(footer), "the checksum of a footer")
        file = pq.ParquetFile(pa.BufferReader(data), page_checksum_verification=True)
        (section,) = json.loads(file.metadata.metadata[b"hybridlog"])
        demand(section["id"] == self._recording, "a file of another recording")
        demand(section["rows"] == file.metadata.num_rows, "the rows of a file")
        table = file.read()
        parts: dict[str, list[int]] = {}
        for row in table.to_pylist():
            parts.setdefault(str(row["channel"]), []).append(row["t"])
        listed_parts = {n: [part[0], *part[2:]] for n, part in listed["parts"].items()}
        demand(
            {n: [len(own), min(own), max(own)] for n, own in parts.items()} == listed_parts,
            "the parts of a file",
        )
        return table
