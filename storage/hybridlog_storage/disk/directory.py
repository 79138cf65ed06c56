"""The store's directory: its files, as `docs/format.md` has them, and its locks."""

from __future__ import annotations

import fcntl
import os
import re
import secrets
import stat
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, ClassVar, Final

from msgspec import Struct, structs
from msgspec.structs import replace

from hybridlog_storage.cells import CATALOG, Cells, cells_of_user
from hybridlog_storage.disk import files
from hybridlog_storage.errors import HeldError, StoreError, TopicError, unreadable
from hybridlog_storage.manifest import Manifest
from hybridlog_storage.manifests import (
    MANIFEST_LOCK,
    MANIFEST_OLD,
    MANIFESTS,
    RECORDINGS,
    WRITER_LOCK,
    DiskManifests,
    Manifests,
)
from hybridlog_storage.segments.segment_file import (
    OPEN_SUFFIX,
    is_rows,
    number_of,
)
from hybridlog_storage.segments.segment_format import SEALED_SUFFIX
from hybridlog_storage.settings import NAME as SETTINGS
from hybridlog_storage.settings import StoreSettings, read_settings, write_settings

LOCK: Final = WRITER_LOCK
LOCK_WAIT_S: Final = 10.0
"""Seconds that a command waits for another one that holds its recording."""
_OF_MANIFEST: Final = frozenset({MANIFEST_LOCK, MANIFEST_OLD})
_TICK_NS: Final = 50_000_000
_RECORDER_WAIT_S = 0.5  # a reader's look at a lock must not pass for a recorder
_HOLDER = 32  # bytes of the line in a lock


class Holder(Struct, frozen=True):
    """The process that holds a recording's lock, by its own account; `name` is for messages.

    Unless `is_recording`, it changes an ended recording.
    """

    name: str
    is_recording: bool


_ANOTHER: Final = Holder("another process", is_recording=False)


class Listing(Struct, frozen=True):
    """Content of a recording's directory.

    Attributes:
        sealed: Names of sealed segments, by number; of those that are gone, of their first file of
            rows once `choosing` has told.
        open: Names of segments that were never sealed, by number.
        sizes: Bytes of sealed segments and files of rows; -1 of what is no ordinary file.
        look: As of `StoreDirectory.looks`, before the names were read.
    """

    sealed: Mapping[int, str]
    open: Mapping[int, str]
    others: tuple[str, ...]
    sizes: Mapping[str, int]
    look: str

    @property
    def rows(self) -> dict[str, int]:
        """Bytes of the files of rows, by name."""
        return {name: size for name, size in self.sizes.items() if is_rows(name)}

    def choosing(self, manifest: Manifest | None) -> Listing:
        """The same as a manifest says; what it does not list, or says is gone, is among others."""
        sealed = dict(self.sealed)
        if manifest is None:
            wanted: dict[int, str] = {}
            for name in sorted(self.rows, key=lambda name: (len(name), name)):
                if int(name[:6]) not in sealed:
                    wanted.setdefault(int(name[:6]), name)
            return replace(self, sealed=dict(sorted((sealed | wanted).items())))
        rows = manifest.rows
        listed = {file.name for own in rows.values() for file in own}
        for number, log in manifest.logs.items():
            if not log.is_here:
                sealed.pop(number, None)
                if (name := rows[number][0].name) in self.rows:
                    sealed[number] = name
        others = {*self.others, *self.sealed.values(), *self.rows} - {*sealed.values()} - listed
        return replace(self, sealed=dict(sorted(sealed.items())), others=tuple(sorted(others)))

    def left_over(self, manifest: Manifest) -> list[str]:
        """Files that were to be deleted.

        Rows of logs that are here, logs whose rows are whole, what a ring has let go.
        """
        found, rows = [], manifest.rows
        for number, log in manifest.logs.items():
            own = rows.get(number, [])
            names = {file.name for file in own}
            found += [n for n in self.rows if int(n[:6]) == number and n not in names]
            has_all = all(self.rows.get(file.name) == file.bytes for file in own)
            if not log.is_here and has_all and number in self.sealed:
                found.append(self.sealed[number])
        there = {**self.sealed, **{int(name[:6]): name for name in self.rows}}
        return found + [n for number, n in there.items() if manifest.has_let_go(number)]


class StoreDirectory:
    """A store's directory; with `read_only` it behaves as if this user could not write it.

    With `is_remote` it stands for a place in a bucket, see `remote.store`. People call it `place`;
    another process opens it by its `address`. `when_empty` is the sentence for a
    store without recordings; `mongod` is the folder of the embedded MongoDB.
    """

    is_remote: ClassVar[bool] = False
    when_empty = "The store is empty: `hybridlog record FILE` fills it."

    def __init__(self, path: Path, *, read_only: bool = False) -> None:
        self.path, self.place, self.address = path, str(path), str(path.absolute())
        self.recordings, self.mongod = path / RECORDINGS, path / "mongod"
        self.manifests: Manifests = DiskManifests(path)
        self.read_only = read_only
        self.settings = read_settings(path)

    @classmethod
    def create(
        cls,
        path: Path,
        *,
        mongo: str | None = None,
    ) -> StoreDirectory:
        """Create a store, or open an existing one.

        `mongo` is the URI, without a password, of the MongoDB to use instead of the embedded one.
        """
        if path.exists() and not path.is_dir():
            raise StoreError(f"{path} is a file; a store is a directory. Choose another name.")
        with files.explained(path, "making the store"):
            if not (path / SETTINGS).exists():
                path.mkdir(parents=True, exist_ok=True)
                # Of several processes, one creates the store and the others open it.
                with files.locked_folder(path):
                    # A temporary settings file left by a crash here does not count.
                    names = {entry.name for entry in path.iterdir()}
                    if SETTINGS not in names:
                        if any(not name.startswith(f".{SETTINGS}.") for name in names):
                            raise StoreError(
                                f"{path} holds files and is not a hybridlog store. Choose an empty "
                                "or a new directory with --store."
                            )
                        settings = StoreSettings(secrets.token_hex(16), mongo=mongo)
                        write_settings(path, settings)
            store = cls(path)
            for folder in (MANIFESTS, RECORDINGS):
                with suppress(FileExistsError):
                    files.make_folder(path / folder)
                    files.sync_folder(path)
        return store

    @property
    def cells(self) -> Cells:
        """Of its catalog; if this user may not write here, in the user's cache."""
        owner = self.settings.store_id
        if self.is_writable:
            return Cells(self.path / CATALOG, owner)
        return cells_of_user(self.address, owner)

    @property
    def is_writable(self) -> bool:
        """True if this user may change the store."""
        if self.read_only:
            return False
        if not os.access(self.path, os.W_OK | os.X_OK):
            return False
        folders = self.path / MANIFESTS, self.path / RECORDINGS  # a copy by hand may lack one
        return all(os.access(one, os.W_OK | os.X_OK) or not one.exists() for one in folders)

    def check_writable(self) -> None:
        """Raise if the store cannot be written."""
        if not self.is_writable:
            raise StoreError(
                f"The store {self.path} is read-only. Check its owner and mount, or choose "
                "another with --store."
            )

    def check_changes(self) -> None:
        """Raise if what users change by their commands cannot be changed; see `check_writable`."""
        self.check_writable()

    def change_settings(self, **changes: Any) -> None:
        """Change settings of the store."""
        with self.manifests.creating():
            settings = structs.replace(read_settings(self.path), **changes)
            with files.explained(self.path, "writing settings of"):
                write_settings(self.path, settings)
            self.settings = settings

    def recording(self, recording: str) -> Path:
        """Directory of a recording, by its id."""
        return self.recordings / recording

    def ids(self) -> list[str]:
        """Ids of all recordings that have a manifest, sorted."""
        return self.manifests.ids()

    def changed(self) -> int:
        """Time at which a manifest came, changed or went last, ns; others may have the same."""
        try:
            return files.status(self.path / MANIFESTS).st_mtime_ns
        except OSError:
            return 0

    def looks(self, ids: Sequence[str]) -> dict[str, str]:
        """The look of each recording, by id; those without a manifest are left out.

        It changes whenever a file gets or loses its name, and when the manifest changes.
        """
        found: dict[str, str] = {}
        if not ids:
            return found
        try:
            with (
                files.folder(self.recordings) as inside,
                suppress(FileNotFoundError),  # a copy by hand may lack the next one
                files.folder(self.path / MANIFESTS) as fd,
            ):
                for one in ids:
                    with suppress(FileNotFoundError):
                        o = os.stat(f"{one}.json", dir_fd=fd, follow_symlinks=False)
                        own = f"{o.st_ino} {o.st_size} {o.st_mtime_ns} {o.st_ctime_ns}"
                        found[one] = f"{_folder_look(one, inside)} {own}"
        except OSError as error:
            raise unreadable(error, self.path, f"The store {self.path}") from error
        return found

    def drop(self, recording: str, names: Collection[str]) -> None:
        """Remove files of a recording, if they are there."""
        files.remove(self.recording(recording), names)

    def look_closely(self, recording: str) -> None:
        """Look which files of a recording are there, and read all anew. Here each question does."""

    def listing(self, recording: str) -> Listing:
        """Read the content of a recording's directory."""
        path = self.recording(recording)
        look = self.looks([recording]).get(recording, "")
        found = {}
        try:
            with suppress(FileNotFoundError):
                found = files.names(path)
        except OSError as error:
            raise unreadable(error, path) from error
        kinds = {name: _numbered(name) for name in sorted(found.keys() - _OF_MANIFEST)}
        sizes = {
            name: found[name].st_size if stat.S_ISREG(found[name].st_mode) else -1
            for name, (_, kind) in kinds.items()
            if kind == SEALED_SUFFIX or is_rows(name)
        }
        return Listing(
            {number: name for name, (number, kind) in kinds.items() if kind == SEALED_SUFFIX},
            {number: name for name, (number, kind) in kinds.items() if kind == OPEN_SUFFIX},
            tuple(name for name, (_, kind) in kinds.items() if not kind and name not in sizes),
            sizes,
            look,
        )

    @contextmanager
    def retaining(self) -> Iterator[None]:
        """Lock out other passes of retention, else `HeldError`."""
        with ExitStack() as held:
            try:
                held.enter_context(files.locked_folder(self.path, 0))
            except BlockingIOError:
                raise HeldError("Another process makes room in this store already.") from None
            except OSError as error:
                raise unreadable(error, self.path) from error
            yield

    @contextmanager
    def writing(
        self,
        recording: str,
        name: str = "",
        *,
        wait_s: float = 0.0,
        records: bool = False,
        makes: bool = False,
    ) -> Iterator[None]:
        """Lock a recording for writing, else `HeldError`; `TopicError` if it is gone.

        `wait_s` is for another command that holds it. A recorder may hold it for hours, so it is
        not waited for. With `makes` it is a new one: its folder is made.
        """
        path = self.recording(recording) / LOCK
        if wait_s and self.is_recorded(recording):
            wait_s = min(wait_s, _RECORDER_WAIT_S)
        fd = -1
        with ExitStack() as held:
            while fd < 0:
                try:
                    fd = held.enter_context(files.locked_file(path, os.O_RDWR | os.O_CREAT, wait_s))
                except FileNotFoundError as error:
                    if not makes and recording not in self.looks([recording]):
                        raise gone(name or recording) from error
                    with files.explained(path.parent, "making"):  # copies leave out empty ones
                        files.make_folders(path.parent)
                        files.sync_folder(self.path)
                        files.sync_folder(self.recordings)
                except BlockingIOError:
                    holder = self.holder(recording) or _ANOTHER
                    what = "being written" if holder.is_recording else "being changed"
                    raise HeldError(
                        f"Recording {name or recording!r} is {what} by {holder.name}. Wait until "
                        "it is done, or stop it."
                    ) from None
                except OSError as error:
                    raise files.explain(error, path, "locking") from error
            line = b"%d %d" % (os.getpid(), records)
            with suppress(OSError):  # a full disk must not keep it from being removed
                files.system.pwritev(fd, [memoryview(line.ljust(_HOLDER))], 0)
            try:
                yield
            finally:
                with suppress(OSError):
                    files.system.truncate(fd, 0)

    def holder(self, recording: str) -> Holder | None:
        """The process that holds a recording's lock at this moment."""
        try:
            fd = files.open_file(self.recording(recording) / LOCK, os.O_RDONLY)
        except OSError:
            return None
        try:
            fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            # By its line; the store may come from another user.
            found = re.fullmatch(rb"([0-9]{1,19}) ([01]) *", os.pread(fd, _HOLDER, 0))
            if found is None:
                return _ANOTHER
            return Holder(f"process {int(found[1])}", is_recording=found[2] == b"1")
        finally:
            os.close(fd)
        return None

    def is_recorded(self, recording: str) -> bool:
        """True if a process records into a directory at this moment."""
        holder = self.holder(recording)
        return holder is not None and holder.is_recording


def gone(name: str) -> TopicError:
    """The error for a recording that was removed meanwhile."""
    return TopicError(f"Recording {name!r} is no longer in the store.")


def _folder_look(recording: str, folders: int) -> str:
    """The look of a recording's folder, which copies of a store leave out if it is empty."""
    try:
        about = os.stat(recording, dir_fd=folders, follow_symlinks=False)
    except FileNotFoundError:
        return "0 0 0"
    return f"{about.st_ino} {about.st_mtime_ns} {about.st_ctime_ns}"


def is_stable(look: str) -> bool:
    """False if the look is so new that it would be the same after another change."""
    times = look.split()[2::4]  # of the folder, and of the manifest
    return all(abs(time.time_ns() - int(one)) > _TICK_NS for one in times)


def _numbered(name: str) -> tuple[int, str]:
    """Number and suffix of a segment's file; an empty suffix for other files."""
    sealed = name.removesuffix(OPEN_SUFFIX) + SEALED_SUFFIX if name.endswith(OPEN_SUFFIX) else name
    found = number_of(sealed)
    if found is None:
        return 0, ""
    return found, SEALED_SUFFIX if sealed == name else OPEN_SUFFIX
