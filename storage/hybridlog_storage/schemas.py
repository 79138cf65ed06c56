"""The message definitions of a store, each once, in a file with the name of its digest.

A file is a line of JSON with the name of the type and the encoding of the definition, and the
definition. Its name is the BLAKE3 of its bytes, so it proves itself and never changes.
"""

from __future__ import annotations

import json
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from blake3 import blake3

from hybridlog_storage.disk import durability, files
from hybridlog_storage.errors import StoreError, unreadable
from hybridlog_storage.messages import Schema

if TYPE_CHECKING:
    from pathlib import Path

FOLDER: Final = "schemas"
MAX_BYTES: Final = 16 << 20
"""Largest definition that is read or stored."""


def encode(schema: Schema) -> tuple[str, bytes]:
    """The name of a definition's file, and its bytes."""
    head = json.dumps([schema.name, schema.encoding]).encode()
    data = head + b"\n" + bytes(schema.data)
    return blake3(data).hexdigest(), data


def decode(digest: str, data: bytes) -> Schema:
    """The definition in the bytes of a file.

    Raises:
        StoreError: They have another digest.
    """
    if blake3(data).hexdigest() != digest:
        raise StoreError(f"The definition {FOLDER}/{digest} is damaged. Restore it from a copy.")
    head, _, text = data.partition(b"\n")
    name, encoding = json.loads(head)  # as they were written: the digest is right
    return Schema(str(name), str(encoding), text)


class Schemas:
    """The definitions of a store in a directory.

    Args:
        path: The store.
    """

    def __init__(self, path: Path) -> None:
        self._folder = path / FOLDER
        self._known: set[str] = set()

    def put(self, schema: Schema) -> str:
        """Store a definition, unless it is there; returns its digest.

        Raises:
            DiskFullError: There is no room.
            StoreError: It is too large, or cannot be written.
        """
        digest, data = encode(schema)
        if len(data) > MAX_BYTES:
            raise StoreError(f"The definition of {schema.name} has {len(data)} bytes: too many.")
        path = self._folder / digest
        if digest in self._known:
            return digest
        try:
            with suppress(FileExistsError):
                files.make_folder(self._folder)
                files.sync_folder(self._folder.parent)
            if not self._is_whole(path, len(data)):
                files.write_file(path, data)
        except OSError as error:
            raise durability.explain(error, path, "writing") from error
        self._known.add(digest)
        return digest

    def _is_whole(self, path: Path, size: int) -> bool:
        with suppress(FileNotFoundError):
            return files.status(path).st_size == size
        return False

    def get(self, digest: str) -> Schema:
        """A definition.

        Raises:
            StoreError: It is missing or damaged.
        """
        path = self._folder / digest
        try:
            return decode(digest, files.read_file(path, MAX_BYTES))
        except FileNotFoundError:
            raise StoreError(f"{path} is missing. Restore it from a copy.") from None
        except OSError as error:
            raise unreadable(error, path) from error

    def digests(self) -> set[str]:
        """Digests of all that are there."""
        with suppress(FileNotFoundError):
            return {name for name in files.names(self._folder) if not name.startswith(".")}
        return set()
