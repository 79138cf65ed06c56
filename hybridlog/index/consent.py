"""The user's consent to MongoDB servers that stores refer to.

A store may be untrusted, and its `hybridlog.toml` may name any server. So the URI
in it is used only if this user created the store with it, or agreed to it later.
Agreements are outside all stores, in `$XDG_STATE_HOME/hybridlog/trusted.json`.
"""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

from hybridlog_storage.disk import durability, files
from hybridlog_storage.disk.files import user_directory
from hybridlog_storage.errors import DatabaseError, StoreError
from hybridlog_storage.settings import EMBEDDED, NONE, without_password

if TYPE_CHECKING:
    from hybridlog_storage.settings import StoreSettings

_NAME: Final = "trusted.json"
_LIMIT: Final = 16 << 20  # bytes
_STORES: Final = "stores"


def trusted_uri(settings: StoreSettings, store: Path | None = None) -> str:
    """The URI that a store may use, `embedded`, or `none`.

    Raises:
        DatabaseError: the store names a server that this user has not agreed to.
    """
    if settings.mongo is None:
        return EMBEDDED
    if settings.mongo == NONE:
        return NONE
    if is_trusted(settings.store_id, settings.mongo):
        return settings.mongo
    from hybridlog_storage.mongo.database import without_secrets  # loads numpy

    place = "DIR" if store is None else str(store)
    raise DatabaseError(
        f"The store names a MongoDB at {without_secrets(settings.mongo)}, to which this user has "
        f"not agreed: the store may come from somebody else. `hybridlog index trust --store "
        f"{place}` agrees to it for good, `--mongo URI` names one for a single command."
    )


def is_trusted(store_id: str, uri: str) -> bool:
    """True if this user has agreed that a store uses a server."""
    return without_password(uri) in _trusted().get(store_id, ())


def trust(store_id: str, uri: str) -> None:
    """Agree that a store uses a server.

    Args:
        store_id: The store.
        uri: The server; it is stored without its password.

    Raises:
        StoreError: the agreement cannot be stored.
    """
    with _changing() as trusted:
        uris = trusted.setdefault(store_id, [])
        if (clean := without_password(uri)) not in uris:
            uris.append(clean)


def revoke(store_id: str) -> bool:
    """Revoke the agreement to all servers of a store.

    Returns:
        True if there was an agreement.

    Raises:
        StoreError: the change cannot be stored.
    """
    with _changing() as trusted:
        return trusted.pop(store_id, None) is not None


def state_directory() -> Path:
    """Directory of this user's agreements.

    Raises:
        StoreError: this user has no home directory.
    """
    return user_directory("XDG_STATE_HOME", ".local/state", "trusted servers")


def _trusted() -> dict[str, list[str]]:
    """URIs by store; empty if the file is missing, damaged, or writable by other users."""
    try:
        path = state_directory() / _NAME
        about = files.status(path)
        if about.st_uid != os.geteuid() or stat.S_IMODE(about.st_mode) & 0o022:
            return {}
        stores = json.loads(files.read_file(path, _LIMIT))[_STORES]
        return {str(store): [str(uri) for uri in uris] for store, uris in stores.items()}
    except (
        OSError,
        StoreError,
        ValueError,
        LookupError,
        TypeError,
        AttributeError,
        RecursionError,
    ):
        return {}


@contextmanager
def _changing() -> Iterator[dict[str, list[str]]]:
    """The agreements, locked against other processes during a change."""
    directory = state_directory()
    path = directory / _NAME
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        with files.locked_folder(directory):
            trusted = _trusted()
            yield trusted
            content = json.dumps({_STORES: trusted}, indent=2) + "\n"
            files.write_file(path, content.encode(), 0o600)
    except OSError as error:
        raise durability.explain(error, path, "remembering trusted servers in") from error
