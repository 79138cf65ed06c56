"""Registers the place of a store in its database, so that a copied store is noticed.

A copy of a store has the same id and names the same MongoDB. If both used it, each would
treat the other's recordings as removed. So the database stores the place of its store.
"""

from __future__ import annotations

import os
import platform
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace

from hybridlog_storage.errors import StoreError, UsageError
from hybridlog_storage.settings import EMBEDDED, is_uri, read_settings, write_settings

if TYPE_CHECKING:
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.mongo.database import Database


def place_of(directory: StoreDirectory) -> dict[str, Any]:
    """A store's id, host and path."""
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
    """Check that a database holds only the index of the store at this place.

    Args:
        mark: The database's owner; None without one.
        place: From `place_of`; its `id` is empty for a store that does not exist yet.
        database: The database, for messages.
        embedded: Whether it lies in the store, and is moved and copied with it.

    Returns:
        Whether the place must be written to the database.

    Raises:
        StoreError: It holds the index of another store, or of the original of this copy.
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
        "here. A copy needs an index of its own: `hybridlog verify --repair --new-id --mongo "
        "URI`. A store that was moved takes the index along: `hybridlog verify --repair --moved`. "
        "Nothing was changed."
    )


def _has_moved(mark: Mapping[str, Any], place: Mapping[str, Any]) -> bool:
    """True if the store is no longer at the registered place; only known for this host."""
    if mark["host"] != place["host"]:
        return False
    try:
        return read_settings(Path(str(mark["path"]))).store_id != str(place["id"])
    except StoreError:
        return not os.path.lexists(str(mark["path"]))


def become_another(path: Path, mongo: str | None) -> None:
    """Give a copied store a new id.

    Args:
        path: The store.
        mongo: URI of the MongoDB for its index, `embedded`, or `none`; None to keep the embedded
            one, or none.

    Raises:
        UsageError: It names a MongoDB, and no other one is given.
        StoreError: It cannot be written.
    """
    from hybridlog.index import consent

    settings = read_settings(path)
    if is_uri(settings.mongo) and mongo is None:
        raise UsageError(
            "The copy names the same MongoDB as the store that it was copied from. Give it one "
            "of its own: --mongo mongodb://host/NAME, or --mongo embedded."
        )
    own = None if mongo == EMBEDDED else mongo or settings.mongo
    changed = replace(settings, store_id=secrets.token_hex(16), mongo=own)
    write_settings(path, changed)
    if is_uri(own):
        consent.trust(changed.store_id, own)
