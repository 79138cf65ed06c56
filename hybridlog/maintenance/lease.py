"""Which place a database belongs to, so that a copied store is noticed.

A copy of a store has the same id and names the same MongoDB. If both used it, each would
take the other's recordings for gone. So the database says where its store lies.
"""

from __future__ import annotations

import os
import platform
import secrets
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hybridlog_storage.errors import StoreError, UsageError
from hybridlog_storage.settings import EMBEDDED, read_settings, write_settings

if TYPE_CHECKING:
    from hybridlog_storage.database import Database
    from hybridlog_storage.directory import StoreDirectory


def place_of(directory: StoreDirectory) -> dict[str, Any]:
    """A store's id, and the host and path where it lies."""
    return {
        "id": directory.settings.store_id,
        "host": platform.node(),
        "path": os.path.realpath(directory.path),
    }


def check(
    mark: Mapping[str, Any] | None,
    place: Mapping[str, Any],
    database: Database,
    *,
    embedded: bool = False,
) -> bool:
    """Check that a database holds no index but that of a store at a place.

    Args:
        mark: What the database says; None if it is nobody's.
        place: From `place_of`; its `id` is empty for a store that is yet to be made.
        database: For messages.
        embedded: Whether it lies in the store itself, and moves and is copied with it.

    Returns:
        Whether the database has to be told of the place.

    Raises:
        StoreError: It holds the index of another store, or of the store that this one is a
            copy of.
    """
    if mark is None:
        return True
    if mark.get("id") != place["id"]:
        raise StoreError(
            f"The database {database.name!r} at {database.address} holds the index of "
            "another store. Name a database of its own in the URI: mongodb://host/NAME."
        )
    where = mark.get("host"), mark.get("path")
    if where == (place["host"], place["path"]):
        return False
    if embedded or None in where or _has_moved(mark, place):
        return True
    raise StoreError(
        f"The database {database.name!r} at {database.address} belongs to the store at "
        f"{mark['path']} on {mark['host']}, and this one is a copy of it, or that one was moved "
        "here. A copy needs an index of its own: `hybridlog repair --new-id --mongo URI`. A "
        "store that was moved takes the index along: `hybridlog repair --moved`. Nothing was "
        "changed."
    )


def _has_moved(mark: Mapping[str, Any], place: Mapping[str, Any]) -> bool:
    """Whether the store is no longer where the database says; only this host can be asked."""
    if mark["host"] != place["host"]:
        return False
    try:
        return read_settings(Path(str(mark["path"]))).store_id != str(place["id"])
    except StoreError:
        return not os.path.lexists(str(mark["path"]))


def become_another(path: Path, mongo: str | None) -> None:
    """Give a store that is a copy an id of its own.

    Args:
        path: The store.
        mongo: URI of the MongoDB for its index, or `embedded`; None to keep the embedded one.

    Raises:
        UsageError: It names a MongoDB, and no other one was given.
        StoreError: It cannot be written.
    """
    from hybridlog import consent

    settings = read_settings(path)
    if settings.mongo is not None and mongo is None:
        raise UsageError(
            "The copy names the same MongoDB as the store that it was copied from. Give it one "
            "of its own: --mongo mongodb://host/NAME, or --mongo embedded."
        )
    own = None if mongo in {None, EMBEDDED} else mongo
    changed = replace(settings, store_id=secrets.token_hex(16), mongo=own)
    write_settings(path, changed)
    if own is not None:
        consent.remember(changed.store_id, own)
