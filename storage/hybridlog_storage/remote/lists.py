"""Lists of what a store in a bucket holds: one object, created once, for each state of it.

A list names every file of every recording with its object, size and version, and has the
catalog. It is the moment at which a change counts: what no list names is not in the store. The
names of lists count down, so that the newest is listed first.

```
zlib of:
<one line of JSON: format, store, recordings, tables>
<the catalog, an SQLite database>
```
"""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from hybridlog_storage.errors import StoreError
from hybridlog_storage.manifest import is_id
from hybridlog_storage.remote.bucket import Object

LISTS: Final = "lists"
RECORDINGS: Final = "recordings"
TABLES: Final = "tables"
MANIFEST: Final = "manifest.json"
"""Path under which a list has the manifest of a recording."""
MAX_LIST: Final = 1 << 30
"""Largest list that is read, bytes, packed and unpacked."""
_FORMAT: Final = 1
_LAST: Final = (1 << 64) - 1
_PART: Final = re.compile(r"[^/\x00]{1,255}")
_MAX_DEPTH: Final = 3


@dataclass(frozen=True, slots=True)
class StoreList:
    """One state of a store.

    Attributes:
        store: Id of the store.
        number: Counts states, from 1; 0 before the first.
        recordings: The object of each file of each recording, by its id and the path below it.
        tables: The object of each file of fields, by path below `tables`.
        catalog: The catalog, as an SQLite database.
    """

    store: str
    number: int = 0
    recordings: Mapping[str, Mapping[str, Object]] = field(default_factory=dict)
    tables: Mapping[str, Object] = field(default_factory=dict)
    catalog: bytes = b""

    def to_bytes(self) -> bytes:
        """The content of its object."""
        head = {
            "format": _FORMAT,
            "store": self.store,
            "recordings": {one: _rows(objects) for one, objects in self.recordings.items()},
            "tables": _rows(self.tables),
        }
        line = json.dumps(head, separators=(",", ":")).encode() + b"\n"
        return zlib.compress(line + self.catalog, 6)

    @classmethod
    def from_bytes(cls, store: str, number: int, data: bytes, place: str) -> StoreList:
        """A list, of which nothing is believed that does not fit.

        Raises:
            StoreError: It is damaged, of another store, or of a newer version.
        """
        try:
            unpacked = zlib.decompressobj()
            content = unpacked.decompress(data, MAX_LIST)
            if not unpacked.eof:
                raise ValueError("it is not whole")
            line, _, rest = content.partition(b"\n")
            head = json.loads(line)
            if head["format"] != _FORMAT:
                raise StoreError(f"{place} is of a newer version. Install a newer hybridlog.")
            if head["store"] != store:
                raise ValueError("it is of another store")
            found = {
                one: _objects(rows, f"{RECORDINGS}/{one}/")
                for one, rows in head["recordings"].items()
            }
            if not all(map(is_id, found)):
                raise ValueError("it names no recording")
            tables = _objects(head["tables"], f"{TABLES}/")
            return cls(store, number, found, tables, rest)
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError, zlib.error) as e:
            raise StoreError(f"{place} is damaged: {e}.") from e


def list_name(number: int) -> str:
    """The name of the object of a list; later ones are sorted first."""
    return f"{LISTS}/{_LAST - number:020d}"


def number_of(name: str) -> int | None:
    """The number of a list by the name of its object; None for other objects."""
    found = re.fullmatch(rf"{LISTS}/(\d{{20}})", name, re.ASCII)
    number = _LAST - int(found[1]) if found else -1
    return number if number > 0 else None


def _rows(objects: Mapping[str, Object]) -> dict[str, list[Any]]:
    return {path: [one.name, one.size, one.version] for path, one in objects.items()}


def _objects(rows: Any, prefix: str) -> dict[str, Object]:
    found = {}
    for path, (name, size, version) in rows.items():
        parts = path.split("/")
        is_path = len(parts) <= _MAX_DEPTH and not {"..", ".", ""} & {*parts}
        if not is_path or not all(_PART.fullmatch(part) for part in parts):
            raise ValueError(f"{path!r} is no path of a file")
        if not isinstance(name, str) or not name.startswith(prefix) or ".." in name.split("/"):
            raise ValueError(f"{name!r} is no object of this store")
        if type(size) is not int or not 0 <= size < 1 << 50 or not isinstance(version, str):
            raise ValueError(f"{path} has no size or version")
        found[path] = Object(name, size, version, 0)
    return found


def _checked(form: re.Pattern[str], text: Any) -> str:
    if not isinstance(text, str) or form.fullmatch(text) is None:
        raise ValueError(f"{text!r} is no name here")
    return text
