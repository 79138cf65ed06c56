"""Fields of expired messages, read by the section about them in `docs/format.md` alone.

`pyarrow` reads Parquet; what they mean is from the page.
"""

from __future__ import annotations

import json
import re
import struct
import zlib
from collections.abc import Mapping
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
    """The files of one recording.

    Args:
        folder: Its `payloads`.
        listed: The files that the manifest lists, by path.
        recording: Id of the recording.
    """

    def __init__(
        self, folder: Path, listed: Mapping[str, Mapping[str, Any]], recording: str
    ) -> None:
        self._folder = folder
        self._listed = listed
        self._recording = recording

    def left(self, segment: int, chunk: int) -> list[tuple[int, int, bytes]]:
        """What is left of the messages of an expired chunk, as records in its order.

        Each has the place where its record was, and the bytes that its payload had.
        """
        found: dict[int, tuple[int, int, bytes]] = {}
        for path, listed in self._listed.items():
            file, about = self._checked(self._folder / path, listed)
            for group, chunks in enumerate(about["payloads"]["chunks"]):
                rows = [(s, c) for s, c, count in chunks for _ in range(count)]
                if (segment, chunk) not in rows:
                    continue
                for place, row in zip(rows, file.read_row_group(group).to_pylist(), strict=True):
                    ref = row["ref"]
                    demand((ref["seg"], ref["chunk"]) == place, "the chunk of a row")
                    if place == (segment, chunk):
                        head = row["channel"], ref["sequence"], row["t"], row["pub"]
                        size = 22 + len(ref["left"])
                        record = struct.pack("<BQHIQQ", 5, size, *head) + ref["left"]
                        found[ref["off"]] = ref["off"] - 31, ref["len"], record
        return [found[at] for at in sorted(found)]

    def _checked(self, path: Path, listed: Mapping[str, Any]) -> tuple[pq.ParquetFile, Any]:
        """A file whose checksums are right, and what it says of itself."""
        demand(path.is_file(), "a file of fields is missing")
        data = path.read_bytes()
        demand(len(data) == listed["bytes"] and data[-4:] == b"PAR1", "the size of a file")
        begin = len(data) - 8 - int.from_bytes(data[-8:-4], "little")
        footer = data[begin:]
        demand(blake3(data).hexdigest() == listed["digest"], "the digest")
        (seal,) = re.finditer(rb"hybridlog-footer:([0-9a-f]{8})", footer)
        blank = footer[: seal.start(1)] + b"0" * 8 + footer[seal.end(1) :]
        demand(seal[1] == b"%08x" % zlib.crc32(blank), "the checksum of a footer")
        file = pq.ParquetFile(pa.BufferReader(data))
        about = json.loads(file.metadata.metadata[b"hybridlog"])
        demand(about["version"] == 2 and about["body"] == begin, "the body of a file")
        (section,) = about["recordings"]
        demand(section["id"] == self._recording, "a file of another recording")
        blocks = [data[at : min(at + (32 << 10), begin)] for at in range(0, begin, 32 << 10)]
        checksums = "".join(f"{zlib.crc32(block):08x}" for block in blocks)
        demand(checksums == about["checksums"], "the checksum of a block")
        rows = {listed["topic"]: [listed["messages"], 0, 0, 0]}
        demand(section["topics"] == rows, "the rows of a file")
        return file, about
