"""MongoDB servers of stores that this user has named.

A store may come from somebody else, and its `hybridlog.toml` may name any server. So the URI
in it is used only if this user created the store with it, or has named it by `--mongo`. That is
remembered outside all stores, by an empty file of this user in `$XDG_STATE_HOME/hybridlog/trusted`.
"""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from hashlib import sha256
from typing import TYPE_CHECKING, Final

from hybridlog_storage.disk import durability, files
from hybridlog_storage.disk.files import user_directory
from hybridlog_storage.errors import DatabaseError, StoreError
from hybridlog_storage.settings import EMBEDDED, is_uri, without_password

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog_storage.settings import StoreSettings

_FOLDER: Final = "trusted"


def trusted_uri(settings: StoreSettings, store: Path, named: str | None = None) -> str:
    """The URI that a store uses, `embedded`, or `none`.

    `named` is the one that this user names now; it is remembered if it is the store's own. A
    store's server that this user has never named raises DatabaseError.
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
    """True if this user has named a server for a store."""
    with suppress(OSError, StoreError):
        about = files.status(_mark(store_id, uri))
        return stat.S_ISREG(about.st_mode) and about.st_uid == os.geteuid()
    return False


def trust(store_id: str, uri: str) -> None:
    """Remember that this user has named a server for a store."""
    if is_trusted(store_id, uri):
        return
    path = _mark(store_id, uri)
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        os.close(files.open_file(path, os.O_WRONLY | os.O_CREAT, 0o600))
    except OSError as error:
        raise durability.explain(error, path, "remembering trusted servers in") from error


def _mark(store_id: str, uri: str) -> Path:
    """The empty file which says that this user has named a server for a store."""
    name = sha256(f"{store_id} {without_password(uri)}".encode("utf-8", "surrogatepass"))
    return state_directory() / _FOLDER / name.hexdigest()


def state_directory() -> Path:
    """Directory of what hybridlog remembers for this user."""
    return user_directory("XDG_STATE_HOME", ".local/state", "trusted servers")
