"""The manifests of a store, in a directory or a bucket: replaced as a whole, if unchanged.

A change is a function of the newest manifest. On a disk it is made under the lock of the
recording; in a bucket, on condition that the object is still the one that was read, or else
again. So no change overwrites another one. A change never creates a manifest, so nothing comes
back that was removed. `docs/format.md` has the names of the files.
"""

from __future__ import annotations

import errno
import os
import random
import time
from abc import ABC, abstractmethod
from contextlib import ExitStack, contextmanager, suppress
from typing import TYPE_CHECKING, ClassVar, Final

from hybridlog_storage.disk import files
from hybridlog_storage.errors import (
    DiskFullError,
    ExistsError,
    HeldError,
    ManifestError,
    ObjectChangedError,
    RecordingGoneError,
    StoreError,
    unreadable,
)
from hybridlog_storage.manifest import MAX_BYTES, Manifest, decode, encode, is_id, replace

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path

WAIT_S: Final = 30.0
"""Longest wait of a change for others, which take milliseconds."""
_NO_LOCKS: Final = frozenset({errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS})
_ODD: Final = frozenset({0, errno.EISDIR, errno.ELOOP, errno.ENOTDIR})  # no file, or no folder
MANIFESTS: Final = "manifests"
RECORDINGS: Final = "recordings"
_SUFFIX: Final = ".json"
_ALL: Final = ".lock"
MANIFEST_LOCK: Final = "manifest.lock"
WRITER_LOCK: Final = "writer.lock"
_LOCKS: Final = frozenset({MANIFEST_LOCK, WRITER_LOCK})
MANIFEST_OLD: Final = "manifest.old"


class Manifests(ABC):
    """The manifests of a store, in a directory or in a bucket; `place` is what people call it."""

    place: str
    cure: ClassVar[str] = "`hybridlog verify --repair` makes it again."

    def ids(self) -> list[str]:
        """Ids of all recordings that have a manifest, sorted; also of those being removed."""
        raise NotImplementedError

    def without(self) -> list[str]:
        """Ids of recordings that have lost their manifest, sorted; of none by default."""
        return []

    def read(self, recording: str) -> Manifest:
        """The newest manifest of a recording; `RecordingGoneError` if there is none."""
        return _present(self._seen(recording)[0])

    def find(self, recording: str) -> Manifest | None:
        """The newest manifest of a recording; None if there is no such recording.

        One that is being removed raises `RecordingGoneError`.
        """
        try:
            found, _ = self._seen(recording)
        except RecordingGoneError:
            return None
        return _present(found)

    def each(self, recordings: Iterable[str]) -> Iterator[Manifest]:
        """The newest manifests of some recordings, without those that cannot be read."""
        for one in recordings:
            with suppress(StoreError):
                yield self.read(one)

    def change(self, recording: str, how: Callable[[Manifest], Manifest]) -> Manifest:
        """Replace a manifest by what `how` makes of the newest one; returns what it then is.

        `how` may be called several times; if it returns what it was given, nothing is written. What
        it raises ends the change. After an error the old manifest is still there.
        """
        return self._change(recording, lambda now: how(_present(now)))

    @contextmanager
    def creating(self) -> Iterator[Callable[[Manifest], None]]:
        """Create manifests; on a disk nobody else can create one meanwhile."""
        yield self._create

    def remove(
        self, recording: str, check: Callable[[Manifest], object] = lambda _: None
    ) -> Manifest:
        """Remove a recording with all its files; finishes a removal that was interrupted.

        `check` gets the newest manifest, and raises to keep the recording. Returns what it was.
        """

        def removed(now: Manifest) -> Manifest:
            if now.status != "removed":
                check(now)
            return replace(now, status="removed")

        says_so = True
        try:
            found = self._change(recording, removed)
        except DiskFullError:  # and who wants to free some space comes here
            says_so, found = False, self._read(recording)[0]
        self._delete_files(recording)
        self._forget(recording, says_so=says_so)
        return found

    def _change(self, recording: str, how: Callable[[Manifest], Manifest]) -> Manifest:
        end = time.monotonic() + WAIT_S
        with self._alone(recording):
            while True:
                now, version = self._read(recording)
                made = how(now)
                if made == now:
                    return now
                new = replace(made, id=now.id, created=now.created, changes=now.changes + 1)
                try:
                    self._replace(recording, encode(new), version)
                except ObjectChangedError:
                    if time.monotonic() > end:
                        raise
                    time.sleep(random.uniform(0, 0.2))  # noqa: S311 - so that others come first
                else:
                    return new

    def _seen(self, recording: str) -> tuple[Manifest, str]:
        """The same as `_read`; in a bucket, as it was at the last look."""
        return self._read(recording)

    def _read(self, recording: str) -> tuple[Manifest, str]:
        """The manifest, also of a removed recording, and its version in a bucket."""
        if not is_id(recording):
            raise RecordingGoneError(f"There is no recording {recording!r}.")
        try:
            data, version = self._get(recording)
        except FileNotFoundError:
            raise RecordingGoneError(f"There is no recording {recording!r}.") from None
        try:
            return decoded(recording, data), version
        except ValueError as error:
            raise ManifestError(
                f"The manifest of {recording} in {self.place} is damaged: {error}. {self.cure}"
            ) from error

    @abstractmethod
    def _get(self, recording: str) -> tuple[bytes, str]:
        """The bytes of a manifest and their version. Raises FileNotFoundError."""

    @abstractmethod
    def _create(self, manifest: Manifest) -> None:
        """Write the manifest of a new recording."""

    @contextmanager
    def _alone(self, recording: str) -> Iterator[None]:
        """Keep others, where there are locks, from replacing a manifest."""
        yield

    @abstractmethod
    def _replace(self, recording: str, data: bytes, version: str) -> None:
        """Replace a manifest. Raises ObjectChangedError if it has another version by now."""

    def _delete_files(self, recording: str) -> None:
        """Delete the files of a removed recording, but not its lock."""
        raise NotImplementedError

    def _forget(self, recording: str, *, says_so: bool) -> None:
        """Delete the manifest of a removed recording, which says so unless the disk was full."""
        raise NotImplementedError


class DiskManifests(Manifests):
    """The manifests of a store in a directory."""

    def __init__(self, path: Path) -> None:
        self.place, self._folder = str(path), path / MANIFESTS
        self._recordings = path / RECORDINGS

    def ids(self) -> list[str]:
        """Ids of all recordings that have a manifest, sorted; also of those being removed."""
        return ids_of(self._names(self._folder))

    def without(self) -> list[str]:
        """Names of folders in `recordings` without a manifest, sorted: lost, or copied by hand.

        Those with nothing but locks are left out: a recording begins, or was removed, or its
        beginning was killed. So are those of copies that have not ended, which have no
        `manifest.lock` yet.
        """
        there = self._names(self._recordings)  # before the manifests, which come later
        manifests, found = {*self._names(self._folder)}, []
        for name in sorted(one for one in there if f"{one}{_SUFFIX}" not in manifests):
            with suppress(OSError):  # it goes at this moment, or is none
                held = {*files.names(self._recordings / name)}
                is_begun = MANIFEST_LOCK in held or not is_id(name)
                if name[0] != "." and not held <= _LOCKS and is_begun:
                    found.append(name)
        return found

    def _names(self, folder: Path) -> list[str]:
        try:
            with files.folder(folder) as fd:
                return os.listdir(fd)  # noqa: PTH208 - of a handle
        except FileNotFoundError:
            return []
        except OSError as error:
            raise unreadable(error, folder) from error

    def path(self, recording: str) -> Path:
        """The path of the manifest of a recording."""
        return self._folder / f"{recording}{_SUFFIX}"

    @contextmanager
    def creating(self) -> Iterator[Callable[[Manifest], None]]:
        """Create manifests; nobody else can create one meanwhile."""
        with files.explained(self._folder, "making"):
            files.make_folders(self._folder)
            files.sync_folder(self._folder.parent)
        _make_file(self._folder / _ALL)
        with _locked(self._folder / _ALL):
            yield self._create

    def _create(self, manifest: Manifest) -> None:
        data, path = encode(manifest), self.path(manifest.id)
        if os.path.lexists(path):
            raise ExistsError(f"There is a recording {manifest.id} already.")
        folder = self._recordings / manifest.id
        with files.explained(path, "writing"):
            self._make_lock(folder)
            with _locked(folder / MANIFEST_LOCK):
                self._write(path, data)

    def _make_lock(self, folder: Path) -> None:
        files.make_folders(folder)
        files.sync_folder(self._recordings.parent)
        files.sync_folder(self._recordings)
        _make_file(folder / MANIFEST_LOCK)

    def _get(self, recording: str) -> tuple[bytes, str]:
        with _plainly(self.path(recording)):
            return files.read_file(self.path(recording), MAX_BYTES), ""

    @contextmanager
    def _alone(self, recording: str) -> Iterator[None]:
        folder = self._recordings / recording
        with ExitStack() as stack:
            try:
                stack.enter_context(_locked(folder / MANIFEST_LOCK))
            except FileNotFoundError:
                if not os.path.lexists(self.path(recording)):
                    raise RecordingGoneError(f"There is no recording {recording!r}.") from None
                self._make_lock(folder)  # copies of a store may leave out what is empty
                stack.enter_context(_locked(folder / MANIFEST_LOCK))
            yield

    def _replace(self, recording: str, data: bytes, version: str) -> None:
        path, old = self.path(recording), self._recordings / recording / MANIFEST_OLD
        with suppress(OSError):
            files.unlink(old)
        with suppress(OSError):  # where there are no links, there is no older one
            files.link(path, old)
        with files.explained(path, "writing"):
            self._write(path, data)

    def _write(self, path: Path, data: bytes) -> None:
        """Write a manifest whose lock is held; a power cut never leaves a part of it."""
        modified = time.time_ns()
        with suppress(FileNotFoundError):
            # Clocks of file systems tick in milliseconds, and sizes and inodes come again: what
            # was read of a manifest must never pass for what another one says.
            modified = max(modified, files.status(path).st_mtime_ns + 1)
        files.write_file(path, data, modified=modified)

    def restore(self, recording: str, make: Callable[[Manifest | None], Manifest]) -> Manifest:
        """Make a manifest again that is lost or damaged; returns the one there if it can be read.

        `make` gets the one before the last change, if there is one; nobody begins a recording
        meanwhile.
        """
        with self.creating() as create:
            with suppress(RecordingGoneError, ManifestError):
                return self._read(recording)[0]
            old = None
            with suppress(OSError, ValueError):
                path = self._recordings / recording / MANIFEST_OLD
                old = decoded(recording, files.read_file(path, MAX_BYTES))
            made = replace(make(old), status="unproven")
            self._drop(recording)
            create(made)
            return made

    def _drop(self, recording: str) -> None:
        with suppress(FileNotFoundError), _plainly(self.path(recording), "removing"):
            files.unlink(self.path(recording))

    def _delete_files(self, recording: str) -> None:
        folder = self._recordings / recording
        explained = files.explained(folder, "deleting")
        with explained, suppress(FileNotFoundError):  # or somebody else has finished
            for name in files.names(folder):
                if name != MANIFEST_LOCK:
                    files.remove_tree(folder / name)
            files.sync_folder(folder)

    def _forget(self, recording: str, *, says_so: bool) -> None:
        # A copy may have created it anew meanwhile, if somebody else has finished the removal.
        # A change makes no lock where there is no manifest, so the folder is empty in the end.
        _make_file(self._folder / _ALL)  # copies of a store may leave out what is empty
        with _locked(self._folder / _ALL):
            with suppress(RecordingGoneError):
                if says_so and self._read(recording)[0].status != "removed":
                    return
            with files.explained(self._folder, "deleting"):
                self._drop(recording)
                files.sync_folder(self._folder)
                files.remove_tree(self._recordings / recording)


def manifests_at(folder: Path) -> Manifests:
    """The manifests of the store in which the folder of a recording lies."""
    store = folder.parent.parent
    return files.mounted[store].manifests if store in files.mounted else DiskManifests(store)


def ids_of(names: Iterable[str]) -> list[str]:
    """Ids of the recordings whose manifests have these names, sorted."""
    ids = (name.removesuffix(_SUFFIX) for name in names if name.endswith(_SUFFIX))
    return sorted(filter(is_id, ids))


def decoded(recording: str, data: bytes) -> Manifest:
    """The manifest of a recording. Raises ValueError."""
    found = decode(data)
    if found.id != recording:
        raise ValueError(f"it is the one of {found.id}")
    return found


def _present(manifest: Manifest) -> Manifest:
    if manifest.status == "removed":
        raise RecordingGoneError(f"The recording {manifest.name} was removed.")
    return manifest


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold a file's lock."""
    with ExitStack() as held:
        try:
            with _plainly(path, "locking"):
                held.enter_context(files.locked_file(path, os.O_RDWR, WAIT_S))
        except BlockingIOError:
            message = f"Another process has held {path} for {WAIT_S:.0f} s; end it."
            raise HeldError(message) from None
        yield


def _make_file(path: Path) -> None:
    with _plainly(path, "locking"):
        os.close(files.open_file(path, os.O_RDWR | os.O_CREAT))


@contextmanager
def _plainly(path: Path, changing: str = "") -> Iterator[None]:
    """Say why the system refuses something of a file; not that it is missing, or locked."""
    try:
        yield
    except (FileNotFoundError, BlockingIOError):
        raise
    except OSError as error:
        if error.errno in _NO_LOCKS:
            raise StoreError(
                f"The file system of {path.parent} has no locks (flock), so the store can only be "
                "read there. Copy it to another one to change it."
            ) from error
        if error.errno in _ODD:
            raise ManifestError(
                f"{path} is a link, or of another kind than a store has there: move it out of the "
                "store, then run `hybridlog verify --repair`."
            ) from error
        explained = files.explain(error, path, changing)
        raise (explained if changing else unreadable(error, path)) from error
