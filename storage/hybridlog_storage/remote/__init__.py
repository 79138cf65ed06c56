"""Objects in a bucket: S3, Google Cloud Storage, Azure. Imports: disk."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

from hybridlog_storage.disk.directory import StoreDirectory

_ADDRESS: Final = re.compile(r"(s3|gs|az):/{1,2}([^/].*)")


def address_of(path: str | Path) -> str | None:
    """The address of a store in a bucket, which a `Path` may have lost a slash of; else None."""
    found = _ADDRESS.fullmatch(str(path))
    return f"{found[1]}://{found[2].rstrip('/')}" if found else None


def directory_of(path: str | Path, *, read_only: bool = False) -> StoreDirectory:
    """The directory of an existing store, here or in a bucket; `read_only` keeps it as it is."""
    address = address_of(path)
    if address is None:
        return StoreDirectory(Path(path), read_only=read_only)
    from hybridlog_storage.remote.store import RemoteDirectory

    return RemoteDirectory(address, read_only=read_only)
