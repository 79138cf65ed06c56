"""Ways to damage files of a store, and what it derives from its recordings."""

from __future__ import annotations

import os
import random
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

Way = Callable[[Path], object]
"""Damages the directory `mongod/data` of a store whose mongod has ended."""


def flip(path: Path, *places: float, bits: int = 1) -> None:
    """Flip bits of some bytes of a file: from its begin or its end, or a share of its length."""
    data = bytearray(path.read_bytes())
    for at in places:
        data[at if isinstance(at, int) else int(len(data) * at)] ^= bits
    path.write_bytes(data)


def _remove(paths: Iterable[Path]) -> None:
    for path in paths:
        path.unlink()


def _empty(paths: Iterable[Path]) -> None:
    for path in paths:
        path.write_bytes(b"")


def _cut(paths: Iterable[Path]) -> None:
    for path in paths:
        os.truncate(path, path.stat().st_size // 2)


def _garble(paths: Iterable[Path]) -> None:
    for path in paths:
        path.write_bytes(random.Random(path.stat().st_size).randbytes(path.stat().st_size or 50))


def _garble_behind_the_head(paths: Iterable[Path]) -> None:
    """mongod starts with such a file, and fails when a question reads it."""
    for path in paths:
        content = bytearray(path.read_bytes())
        content[4096:] = bytes(byte ^ 0x5A for byte in content[4096:])
        path.write_bytes(content)


def _biggest(data: Path) -> list[Path]:
    return [max(data.glob("collection-*"), key=lambda path: path.stat().st_size)]


def _replace(path: Path, content: str | None) -> None:
    """A file in place of a directory; None for a directory in place of a file."""
    if content is None:
        path.unlink(missing_ok=True)
        path.mkdir()
    else:
        shutil.rmtree(path)
        path.write_text(content)


def _swap(one: Path, other: Path) -> None:
    content = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(content)


_KINDS = {"removed": _remove, "empty": _empty, "cut": _cut, "garbled": _garble}
_NAMES = (
    *("WiredTiger", "WiredTiger.lock", "WiredTiger.turtle", "WiredTiger.wt", "WiredTigerHS.wt"),
    *("_mdb_catalog.wt", "sizeStorer.wt", "storage.bson", "mongod.lock"),
    *("collection-*", "index-*", "journal/*"),
)


def _in_files(pattern: str, damage: Callable[[Iterable[Path]], None]) -> Way:
    return lambda data: damage(sorted(data.glob(pattern)))


WAYS: dict[str, Way] = {
    **{
        f"{name} {kind}": _in_files(name, damage)
        for name in _NAMES
        for kind, damage in _KINDS.items()
    },
    **{
        f"{name} garbled behind the head": _in_files(name, _garble_behind_the_head)
        for name in ("collection-*", "index-*")
    },
    "a collection removed": lambda data: _remove(_biggest(data)),
    "a collection empty": lambda data: _empty(_biggest(data)),
    "a collection cut": lambda data: _cut(_biggest(data)),
    "a collection garbled": lambda data: _garble(_biggest(data)),
    "a collection garbled behind the head": lambda data: _garble_behind_the_head(_biggest(data)),
    "two collections exchanged": lambda data: _swap(
        *sorted(data.glob("collection-*"), key=lambda path: path.stat().st_size)[-2:]
    ),
    "text for metadata": lambda data: (data / "WiredTiger.wt").write_text("no database\n"),
    "half made": lambda data: _remove(p for p in sorted(data.iterdir())[3:] if p.is_file()),
    "no journal": lambda data: shutil.rmtree(data / "journal"),
    "a file for the journal": lambda data: _replace(data / "journal", "x"),
    "a folder for the lock": lambda data: _replace(data / "mongod.lock", None),
    "a folder for the turtle": lambda data: _replace(data / "WiredTiger.turtle", None),
    "no data": shutil.rmtree,
    "empty data": lambda data: (shutil.rmtree(data), data.mkdir()),
    "no directory": lambda data: shutil.rmtree(data.parent),
}
