"""The store on disk: where things lie, and who may touch them.

```
<store>/
  hybridlog.toml        format version, id of the store, settings
  recordings/<id>/      segments of one recording, and columns; writer.lock while it is written
  mongod/               data of the embedded MongoDB
```
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import secrets
import shutil
import time
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from hybridlog_storage import durability
from hybridlog_storage.errors import StoreError, UsageError
from hybridlog_storage.segment_file import OPEN_SUFFIX, SEALED_SUFFIX

FORMAT: Final = 1
_SETTINGS: Final = "hybridlog.toml"
_LOCK: Final = "writer.lock"
_MAX_SETTINGS: Final = 1 << 20
_FRESH_S: Final = 600.0


@dataclass(frozen=True, slots=True)
class StoreSettings:
    """What `hybridlog.toml` says.

    Attributes:
        store_id: Drawn at random when the store was made.
        mongo: URI of the MongoDB to use instead of the embedded one, None for that.
    """

    store_id: str
    mongo: str | None = None


class StoreDirectory:
    """A store's directory.

    Raises:
        StoreError: there is no store, it is of a newer format, or cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.settings = _read_settings(path)

    @classmethod
    def create(cls, path: Path, *, mongo: str | None = None) -> StoreDirectory:
        """Make a store, or open the one that is there.

        Raises:
            StoreError: the directory holds something else, or cannot be written.
        """
        if path.exists() and not path.is_dir():
            raise StoreError(f"{path} is a file; a store is a directory. Choose another name.")
        try:
            if not (path / _SETTINGS).exists():
                path.mkdir(parents=True, exist_ok=True)
                # Of several processes one makes the store, and the others open it.
                with _alone(path):
                    cls._make(path, mongo)
            store = cls(path)
            (path / "recordings").mkdir(exist_ok=True)
        except OSError as error:
            raise durability.explain(error, path, "making the store") from error
        return store

    @staticmethod
    def _make(path: Path, mongo: str | None) -> None:
        names = {entry.name for entry in path.iterdir()}
        if _SETTINGS in names:
            return
        # What a crash in here has left of the settings is no file of anybody's.
        if any(not name.startswith(f".{_SETTINGS}.") for name in names):
            raise StoreError(
                f"{path} holds files and is no hybridlog store. "
                "Choose an empty or a new directory with --store."
            )
        lines = [f"format = {FORMAT}", f'store_id = "{secrets.token_hex(8)}"']
        if mongo is not None:
            lines.append(f"mongo = {json.dumps(mongo)}")
        durability.write_new(path / _SETTINGS, ("\n".join(lines) + "\n").encode())

    def check_writable(self) -> None:
        """Refuse a store that cannot be written, before anything is tried.

        Raises:
            StoreError: it is read-only for this user.
        """
        if not os.access(self.path / "recordings", os.W_OK | os.X_OK):
            raise StoreError(
                f"The store {self.path} is read-only. Check its owner and mount, or choose "
                "another with --store."
            )

    @property
    def mongod(self) -> Path:
        """Directory of the embedded MongoDB."""
        return self.path / "mongod"

    def recording(self, recording_id: str) -> Path:
        """Directory of a recording."""
        return self.path / "recordings" / recording_id

    def recording_ids(self) -> list[str]:
        """Ids of all recordings that have a directory, sorted."""
        try:
            with os.scandir(self.path / "recordings") as entries:
                return sorted(
                    e.name for e in entries if e.is_dir(follow_symlinks=False) and e.name[0] != "."
                )
        except FileNotFoundError:
            return []
        except OSError as error:
            raise StoreError(f"The store {self.path} cannot be read: {error.strerror}.") from error

    def new_recording(self, name: str) -> str:
        """Make a directory for a new recording; returns its id, made from the name."""
        base = re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-.")[:80] or "recording"
        number = 1
        while True:
            recording_id = base if number == 1 else f"{base}-{number}"
            try:
                self.recording(recording_id).mkdir(parents=True)
            except FileExistsError:
                number += 1
            except OSError as error:
                raise durability.explain(error, self.path, "starting a recording in") from error
            else:
                durability.sync_directory(self.path / "recordings")
                return recording_id

    def is_beginning(self, recording_id: str) -> bool:
        """Whether an empty recording may be one that somebody is just about to lock."""
        path = self.recording(recording_id)
        try:
            return not (path / _LOCK).exists() and time.time() - path.stat().st_mtime < _FRESH_S
        except FileNotFoundError:
            return True

    def remove_recording(self, recording_id: str) -> None:
        """Delete a recording's files: first out of sight, then from the disk."""
        source = self.recording(recording_id)
        hidden = source.with_name(f".removed-{recording_id}-{secrets.token_hex(4)}")
        try:
            source.rename(hidden)
            shutil.rmtree(hidden)
        except OSError as error:
            raise durability.explain(error, source, "removing") from error

    def segments(self, recording_id: str) -> list[tuple[int, Path]]:
        """Number and path of the sealed segments of a recording, in order."""
        return _numbered(self.recording(recording_id), SEALED_SUFFIX)

    def open_segments(self, recording_id: str) -> list[tuple[int, Path]]:
        """Number and path of segments that were never sealed."""
        return _numbered(self.recording(recording_id), OPEN_SUFFIX)

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Keep other processes from starting a recording meanwhile; for moments only."""
        try:
            with _alone(self.path / "recordings"):
                yield
        except OSError as error:
            raise durability.explain(error, self.path, "locking") from error

    @contextmanager
    def using_index(self, *, rebuild: bool = False) -> Iterator[None]:
        """Keep the index from being made anew meanwhile; or, to do just that, be alone.

        Raises:
            StoreError: Another process makes it anew, or uses it.
        """
        path = self.path / _SETTINGS
        try:
            fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            raise durability.explain(error, path, "locking") from error
        try:
            fcntl.flock(fd, (fcntl.LOCK_EX if rebuild else fcntl.LOCK_SH) | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(fd)
            doing = (
                "a recording is being written, checked or removed"
                if rebuild
                else "its index is being made anew"
            )
            raise StoreError(
                f"The store {self.path} is in use: {doing}. Run the command again after that."
            ) from error
        try:
            yield
        finally:
            os.close(fd)

    @contextmanager
    def writing(self, recording_id: str) -> Iterator[bool]:
        """Hold a recording for writing; False when another process does."""
        path = self.recording(recording_id) / _LOCK
        try:
            fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise durability.explain(error, path, "locking") from error
        try:
            try:
                fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                yield False
                return
            yield True
        finally:
            os.close(fd)


@contextmanager
def _alone(directory: Path) -> Iterator[None]:
    """Keep other processes that do the same out of a directory."""
    fd = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX)
        yield
    finally:
        os.close(fd)


def check_recording_id(recording_id: str) -> str:
    """Refuse an id that is no plain directory name."""
    if not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9._-]*", recording_id):
        raise UsageError(f"{recording_id!r} is no recording id; see `hybridlog ls`.")
    return recording_id


def _numbered(directory: Path, suffix: str) -> list[tuple[int, Path]]:
    found = []
    for path in directory.glob(f"*{suffix}"):
        stem = path.name.removesuffix(suffix)
        if stem.isascii() and stem.isdigit():
            found.append((int(stem), path))
    return sorted(found)


def _read_settings(path: Path) -> StoreSettings:
    file = path / _SETTINGS
    try:
        if file.stat().st_size > _MAX_SETTINGS:
            raise StoreError(f"{file} is too large to be settings.")
        values = tomllib.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        reason = "there is no such directory" if not path.exists() else "it has no hybridlog.toml"
        raise StoreError(
            f"{path} is no hybridlog store: {reason}. `hybridlog record FILE --store {path}` "
            "makes one; --store or HYBRIDLOG_STORE says where to look."
        ) from None
    except NotADirectoryError:
        raise StoreError(f"{path} is a file; a store is a directory.") from None
    except OSError as error:
        raise StoreError(f"{file} cannot be read: {error.strerror}.") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise StoreError(f"{file} is damaged: {error}. Restore it or correct it.") from error
    version = values.get("format")
    if not isinstance(version, int) or version < 1:
        raise StoreError(f"{file} names no format version; it should say `format = {FORMAT}`.")
    if version > FORMAT:
        raise StoreError(
            f"The store {path} has format {version}, this hybridlog knows up to {FORMAT}. "
            "Install a newer hybridlog."
        )
    store_id, mongo = values.get("store_id"), values.get("mongo")
    if not isinstance(store_id, str) or not store_id:
        raise StoreError(f"{file} names no store_id.")
    if mongo is not None and not isinstance(mongo, str):
        raise StoreError(f"{file}: mongo must be a URI in quotes.")
    return StoreSettings(store_id, mongo)
