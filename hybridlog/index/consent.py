"""MongoDB servers of stores that this user has named.

A store may come from somebody else, and its `hybridlog.toml` may name any server. So the URI
in it is used only if this user created the store with it, or has named it by `--mongo`. That is
remembered outside all stores, in `$XDG_STATE_HOME/hybridlog/trusted.jsonl`.
"""

from __future__ import annotations

import json
import os
import stat
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from hybridlog_storage.disk import durability, files
from hybridlog_storage.disk.files import user_directory
from hybridlog_storage.errors import DatabaseError, StoreError
from hybridlog_storage.settings import EMBEDDED, is_uri, without_password

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog_storage.settings import StoreSettings

_NAME: Final = "trusted.jsonl"
_LIMIT: Final = 16 << 20  # bytes


def trusted_uri(settings: StoreSettings, store: Path, named: str | None = None) -> str:
    """The URI that a store uses, `embedded`, or `none`.

    Args:
        settings: The store's settings.
        store: Its directory.
        named: The one that this user names now. If it is the store's own, that is remembered.

    Raises:
        DatabaseError: The store names a server that this user has never named.
    """
    own = settings.mongo
    if named is not None:
        if is_uri(named) and is_uri(own) and without_password(named) == without_password(own):
            with suppress(StoreError):  # without a home directory, each command must name it
                trust(settings.store_id, named)
        return named
    if not is_uri(own) or is_trusted(settings.store_id, own):
        return own or EMBEDDED
    from hybridlog_storage.mongo.database import without_secrets  # loads numpy

    raise DatabaseError(
        f"The store {store} names a MongoDB at {without_secrets(own)}, and may come from somebody "
        "else: if that server is yours, name it once by `--mongo URI`."
    )


def is_trusted(store_id: str, uri: str) -> bool:
    """True if this user has named a server for a store.

    A file that is missing, or that other users may write, trusts none.
    """
    with suppress(OSError, StoreError):
        path = state_directory() / _NAME
        lines = files.read_file(path, _LIMIT).splitlines() if _is_own(path) else ()
        return _line(store_id, uri) in lines
    return False


def trust(store_id: str, uri: str) -> None:
    """Remember that this user has named a server for a store.

    Args:
        store_id: The store.
        uri: The server; it is stored without its password.

    Raises:
        StoreError: That cannot be stored.
    """
    if is_trusted(store_id, uri):
        return
    path = state_directory() / _NAME
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with suppress(FileNotFoundError):
            if not _is_own(path):
                files.unlink(path)
        file = files.open_file(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        with os.fdopen(file, "wb") as appended:
            # What stands before may be cut.
            appended.write(b"\n" + _line(store_id, uri) + b"\n")
    except OSError as error:
        raise durability.explain(error, path, "remembering trusted servers in") from error


def _is_own(path: Path) -> bool:
    """True if only this user may write a file."""
    about = files.status(path)
    return about.st_uid == os.geteuid() and not stat.S_IMODE(about.st_mode) & 0o022


def _line(store_id: str, uri: str) -> bytes:
    return json.dumps([store_id, without_password(uri)]).encode()


def state_directory() -> Path:
    """Directory of what hybridlog remembers for this user.

    Raises:
        StoreError: this user has no home directory.
    """
    return user_directory("XDG_STATE_HOME", ".local/state", "trusted servers")
