"""A store in a bucket, as a directory that others read.

Nothing above this knows where files lie: `StoreDirectory` answers from the newest list, and
`files` opens what the list names. Changes create objects and then the next list; who comes
second begins again with what the first one left.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import sqlite3
import stat
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Final

from hybridlog_storage import manifest as truth
from hybridlog_storage.cells import Cells
from hybridlog_storage.checksum import crc32
from hybridlog_storage.disk import files
from hybridlog_storage.disk.directory import LOCK, PAYLOADS, Listing, StoreDirectory, gone
from hybridlog_storage.errors import (
    ManifestError,
    ObjectChangedError,
    ObjectExistsError,
    RecordingGoneError,
    StoreError,
)
from hybridlog_storage.manifest import Manifest, encode
from hybridlog_storage.manifests import MANIFEST_LOCK, MANIFEST_OLD, MANIFESTS, DiskManifests
from hybridlog_storage.remote import TRIES
from hybridlog_storage.remote.blocks import BlockCache, inode_of
from hybridlog_storage.remote.bucket import UNLISTED_DAYS, Bucket, Object, other_name
from hybridlog_storage.remote.lists import (
    LISTS,
    MANIFEST,
    MAX_LIST,
    RECORDINGS,
    TABLES,
    StoreList,
    list_name,
    number_of,
)
from hybridlog_storage.settings import NAME as SETTINGS
from hybridlog_storage.settings import NONE, StoreSettings, read_settings, settings_text

LOOK_EVERY_S: Final = 5.0
"""Seconds between two looks for a newer list, unless this process changes something."""
_READ_NS: Final = 3600 * 10**9  # for so long a reader may need what a newer list has not
_DAY_NS: Final = 86_400 * 10**9
_ALONE: Final = 4  # recordings that are compared with the bucket one by one; then all at once
_MAX_SETTINGS: Final = 1 << 20
_PIECE: Final = 1 << 20  # bytes of a file that are sent at once
_NOT_LISTED: Final = frozenset({LOCK, MANIFEST_LOCK, MANIFEST_OLD})
_FOLDER: Final = stat.S_IFDIR | 0o555
_FILE: Final = stat.S_IFREG | 0o444
_Node = Mapping[str, Any]
"""A folder: an `Object`, bytes, or another folder, by name."""


class BucketFiles:
    """The files of a store in a bucket, by the newest list that was seen.

    Attributes:
        path: What stands for it among paths.
        list: What the store holds; replaced whole.
        lock: Held while the list changes.
        is_changing: True during a change, whose list is not created yet.
    """

    def __init__(self, bucket: Bucket, cache: BlockCache) -> None:
        self.bucket = bucket
        self.path = Path(bucket.address)
        self.list = StoreList("")
        self._cache = cache
        self._settings: tuple[bytes, str] | None = None  # and their version
        self._looked_at = 0.0
        self._tables: tuple[Any, _Node] = None, {}  # of what list, and as folders
        self._compared: set[str] = set()
        self.lock = threading.RLock()
        self.is_changing = False

    # Lists.

    def look(self, store: str, *, now: bool = False) -> None:
        """Look for a newer list, `now` or if the last look is a while ago.

        Raises:
            StoreError: It is damaged.
        """
        with self.lock:
            is_due = now or time.monotonic() - self._looked_at >= LOOK_EVERY_S
            if not is_due or self.is_changing:
                return
            found = self.bucket.first(LISTS)
            number = 0 if found is None else number_of(found.name)
            if number is None:
                raise StoreError(f"{self.bucket.address}/{LISTS} has other objects than lists.")
            if found is None or number <= self.list.number:  # an old answer changes nothing
                self.list = self.list if self.list.store == store else StoreList(store)
            else:
                self.list = self.read_list(store, found)
                self._compared.clear()
                self.bucket.lost.clear()
            self._looked_at = time.monotonic()

    def read_list(self, store: str, about: Object) -> StoreList:
        """One state of the store, by the object of its list.

        Raises:
            StoreError: It is damaged.
        """
        place = f"{self.bucket.address}/{about.name}"
        number = number_of(about.name)
        if number is None:
            raise StoreError(f"{place} is no list.")
        return StoreList.from_bytes(store, number, self.read(about), place)

    def commit(self, before: StoreList, after: StoreList) -> None:
        """Create the next list.

        Raises:
            ObjectExistsError: Another process was faster; `list` has its change.
        """
        with self.lock:
            number = before.number + 1
            after = replace(after, number=number)
            name = list_name(number)
            try:
                self.bucket.create(name, after.to_bytes())
            except ObjectExistsError:
                about = self.bucket.head(name)
                if about is not None:
                    self.list = self.read_list(before.store, about)
                raise
            self.list = after
            self._looked_at = time.monotonic()

    def compare(self, recording: str = "") -> None:
        """Leave out files whose objects are missing, or are not those that the list names.

        Args:
            recording: Id of the recording whose files are compared, once for each list; without
                one all are, and those of fields.
        """
        with self.lock:
            if recording in self._compared or (recording and "" in self._compared):
                return
            listed = self.list
            everything = [one for files_ in listed.recordings.values() for one in files_.values()]
            place = f"{RECORDINGS}/{recording}" if recording else ""
            if len(self._compared) >= _ALONE:  # 1,000 objects are listed at once
                recording, place = "", RECORDINGS
            elif not recording:
                everything += listed.tables.values()
            there = {one.name: (one.size, one.version) for one in self.bucket.objects(place)}
            self.bucket.lost.update(
                one
                for one in everything
                if one.name.startswith(place) and there.get(one.name) != (one.size, one.version)
            )
            self._compared.add(recording)

    def files_of(self, recording: str) -> dict[str, Object]:
        """The object of each file of a recording, without those that are lost."""
        lost = self.bucket.lost
        return {p: o for p, o in self.list.recordings[recording].items() if o not in lost}

    # Files.

    def status(self, inner: tuple[str, ...]) -> os.stat_result:
        """The status of a file or folder, by the names on the way to it."""
        return self._status(self._node(inner), inner)

    def names(self, inner: tuple[str, ...]) -> dict[str, os.stat_result]:
        """The status of each entry of a folder, by name."""
        node = self._node(inner)
        if not isinstance(node, Mapping):
            raise NotADirectoryError(errno.ENOTDIR, "it is not a folder", self._place(inner))
        return {name: self._status(one, (*inner, name)) for name, one in node.items()}

    def open(self, inner: tuple[str, ...]) -> int:
        """A handle for reading a file."""
        node = self._node(inner)
        if isinstance(node, Object):
            return self._cache.open(self.bucket, node)
        if isinstance(node, Mapping):
            raise IsADirectoryError(errno.EISDIR, "it is a folder", self._place(inner))
        with tempfile.TemporaryFile() as file:
            file.write(node)
            file.seek(0)
            return os.dup(file.fileno())

    def read(self, about: Object) -> bytes:
        """A small object."""
        if about.size > MAX_LIST:
            raise StoreError(f"{self.bucket.address}/{about.name} is too large.")
        handle = self._cache.open(self.bucket, about)
        try:
            return files.pread(handle, about.size, 0)
        finally:
            os.close(handle)

    def _status(self, node: Any, inner: tuple[str, ...]) -> os.stat_result:
        if isinstance(node, Mapping):
            listed = self.list.number
            return _stat(_FOLDER, listed, 0, listed)
        if isinstance(node, bytes):
            return _stat(_FILE, crc32(node), len(node))
        return _stat(_FILE, inode_of(node), node.size)

    def _node(self, inner: tuple[str, ...]) -> Any:
        found: Any = self._root(inner)
        for name in inner:
            if not isinstance(found, Mapping) or name not in found:
                problem = "there is no such object"
                if self._is_lost(inner):
                    problem = "its object in the bucket is missing or was changed"
                raise FileNotFoundError(errno.ENOENT, problem, self._place(inner))
            found = found[name]
        return found

    def _is_lost(self, inner: tuple[str, ...]) -> bool:
        """True if the list names a file of a recording whose object is not there."""
        if len(inner) < 3 or inner[0] != RECORDINGS:
            return False
        listed = self.list.recordings.get(inner[1], {})
        return listed.get("/".join(inner[2:])) in self.bucket.lost

    def _root(self, inner: tuple[str, ...]) -> _Node:
        """The folders on the way to a file; others are left out."""
        listed = self.list
        top = inner[0] if inner else ""
        recordings: dict[str, _Node] = {}
        if top == RECORDINGS and len(inner) == 1:
            recordings = {recording: {} for recording in listed.recordings}
        elif top == RECORDINGS and inner[1] in listed.recordings:
            found = {p: o for p, o in self.files_of(inner[1]).items() if p != MANIFEST}
            recordings = {inner[1]: _folder(found)}
        return {
            MANIFESTS: self._manifests(inner[-1]) if top == MANIFESTS else {},
            RECORDINGS: recordings,
            TABLES: self._tables_of(listed) if top == TABLES else {},
            SETTINGS: self.read_settings(),
        }

    def _manifests(self, name: str) -> _Node:
        """The manifest of a recording, by the name of its file."""
        recording = name.removesuffix(".json")
        if recording not in self.list.recordings:
            return {}
        found = self.files_of(recording).get(MANIFEST)
        return {} if found is None else {name: found}

    def _tables_of(self, listed: StoreList) -> _Node:
        known, folders = self._tables
        lost = self.bucket.lost
        if known != (now := (id(listed.tables), len(lost))):
            folders = _folder({path: o for path, o in listed.tables.items() if o not in lost})
            self._tables = now, folders
        return folders

    def read_settings(self) -> bytes:
        """The file of settings, read once.

        Raises:
            FileNotFoundError: There is no store here.
            BucketError: The server does not answer, or refuses.
        """
        with self.lock:
            if self._settings is None:
                about, data = self.bucket.read_whole(SETTINGS, _MAX_SETTINGS)
                self._settings = data, about.version
            return self._settings[0]

    def change_settings(self, change: Callable[[], bytes]) -> None:
        """Replace the file of settings by what is made of the newest one.

        Raises:
            BucketError: The server does not answer, or refuses; or they change all the time.
        """
        with self.lock:
            for left in reversed(range(TRIES)):
                self._settings = None
                self.read_settings()
                assert self._settings is not None
                _, version = self._settings
                try:
                    self.bucket.replace(SETTINGS, change(), version)
                    return
                except ObjectChangedError:
                    if not left:
                        raise
                finally:
                    self._settings = None

    def _place(self, inner: tuple[str, ...]) -> str:
        return "/".join([self.bucket.address, *inner])


_mounting = threading.Lock()


def mount(address: str) -> BucketFiles:
    """The files of a store in a bucket; one for all who use it in this process."""
    path = Path(address)
    with _mounting:
        found = files.mounted.get(path)
        if not isinstance(found, BucketFiles):
            found = files.mounted[path] = BucketFiles(Bucket(address), BlockCache())
        return found


class ListedCells(Cells):
    """The cells of the catalog in the newest list; changes stay in memory until the next one."""

    def __init__(self, source: BucketFiles, store: str) -> None:
        self._source = source
        self._base: StoreList | None = None
        self._is_changing = False
        super().__init__(None, store)

    def _use(self) -> sqlite3.Connection:
        now = self._source.list
        if now is not self._base and not self._is_changing:
            self._base = now
            self._close()
            self._db = self._in_memory(None, now.catalog)
        return super()._use()

    def begin(self) -> None:
        """Begin a change: what is in memory stays there until its end."""
        with self._lock:
            self._use()
            self._is_changing = True

    def end(self) -> None:
        """End a change: the newest list has the cells again."""
        self._is_changing = False
        self._base = None

    def close(self, wait_s: float) -> None:
        """Do nothing: others use the cells, too."""


class ListedManifests(DiskManifests):
    """The manifests of a store in a bucket, by its newest list."""

    def __init__(self, directory: RemoteDirectory) -> None:
        super().__init__(directory.path)
        self._directory = directory

    def ids(self) -> list[str]:
        """All ids, sorted."""
        return self._directory.ids()

    def without(self) -> list[str]:
        """None: a list names all."""
        return []

    def clear(self) -> None:
        """Nothing: what no list names is not there."""

    @contextmanager
    def creating(self) -> Iterator[Callable[[Manifest], None]]:
        """Nothing: who is second begins again; files are not written here one by one."""
        yield lambda _: self._directory.check_writable()

    def change(
        self, recording: str, how: Callable[[Manifest], Manifest], *, sync: bool = True
    ) -> Manifest:
        """The list names a new object in the place of the one before.

        Raises:
            RecordingGoneError: The recording is gone.
            ManifestError: The manifest is damaged or lost.
            ObjectExistsError: Another process was faster: begin again.
        """
        return self._directory.change(recording, how)

    def remove(
        self, recording: str, check: Callable[[Manifest], object] = lambda _: None
    ) -> Manifest:
        """List a recording no more, within `writing`; its objects stay."""
        found = self.read(recording)
        check(found)
        self._directory.drop(recording)
        return found


class RemoteDirectory(StoreDirectory):
    """A store in a bucket. It is read like a directory, and changed by a list at a time.

    Args:
        address: Such as `s3://lab/store`.
        read_only: Refuse all changes.

    Raises:
        StoreError: It is not a store, has another format, or cannot be read.
        BucketError: The server does not answer, or refuses.
    """

    is_remote: ClassVar[bool] = True

    def __init__(self, address: str, *, read_only: bool = False) -> None:
        self.source = mount(address)
        try:
            self.source.read_settings()
        except FileNotFoundError as error:
            raise StoreError(
                f"There is no store at {address}. `hybridlog copy {address}` makes one from a "
                "store on a disk."
            ) from error
        super().__init__(self.source.path, read_only=read_only)
        self.settings = replace(self.settings, mongo=NONE)
        self.source.look(self.settings.store_id, now=True)
        self.manifests = ListedManifests(self)
        self._cells = ListedCells(self.source, self.settings.store_id)
        self._after: StoreList | None = None

    @classmethod
    def create_in(cls, address: str) -> RemoteDirectory:
        """The store at an address; made if there is none.

        Raises:
            BucketError: The server does not answer, refuses, or ignores conditions.
        """
        bucket = mount(address).bucket
        if bucket.head(SETTINGS) is None:
            with suppress(ObjectExistsError):  # another process makes it, too
                bucket.create(
                    SETTINGS,
                    settings_text(StoreSettings(os.urandom(16).hex(), mongo=NONE)),
                )
        return cls(address)

    @property
    def address(self) -> str:
        """The address by which another process opens it."""
        return self.source.bucket.address

    @property
    def place(self) -> str:
        """Its address."""
        return self.source.bucket.address

    @property
    def when_empty(self) -> str:
        """The sentence for a store without recordings."""
        return f"The store is empty: `hybridlog copy {self.place}` fills it from one on a disk."

    @property
    def is_writable(self) -> bool:
        """False: nothing is mended, or noted for others, without being asked to."""
        return False

    def check_writable(self) -> None:
        """Raise: files are not written here one by one."""
        raise StoreError(
            f"{self.source.bucket.address} is a store in a bucket, where this cannot be done. Do "
            "it in a store on a disk, and bring that here with `hybridlog copy`."
        )

    def change_settings(self, **changes: Any) -> None:
        """Change settings of the store."""

        def changed() -> bytes:
            self.settings = replace(read_settings(self.path), **changes)
            return settings_text(self.settings)

        self.check_changes()
        self.source.change_settings(changed)

    def make_folder(self, recording: str) -> None:
        """Raise: nothing is recorded into a bucket."""
        self.check_writable()
        raise AssertionError(recording)

    def catalog_cells(self) -> Cells | None:
        """The cells of the catalog, from the newest list."""
        return self._cells

    @property
    def _now(self) -> StoreList:
        return self.source.list

    def ids(self) -> list[str]:
        """All ids, sorted."""
        return sorted(self._now.recordings)

    def changed(self) -> tuple[int, bool]:
        """The number of the newest list, and True."""
        self.source.look(self.settings.store_id)
        return self._now.number, True

    def looks(self, ids: Sequence[str]) -> dict[str, str]:
        """The look of each recording, by id: it changes whenever any file does."""
        listed = self._now.recordings
        return {one: _look(self.files_of(one)) for one in ids if one in listed}

    def look_closely(self) -> bool:
        """Compare all files with their objects; True if some were lost."""
        self.source.compare()
        return bool(self.source.bucket.lost)

    def listing(self, recording: str) -> Listing:
        """As of a directory; files count whose objects are there."""
        self.source.compare(recording)
        return super().listing(recording)

    @contextmanager
    def retaining(self) -> Iterator[bool]:
        """Always true: of two changes at once, the second begins again."""
        yield True

    @property
    def listed_bytes(self) -> int:
        """Bytes of all files that the newest list names."""
        everything = (*self._now.recordings.values(), self._now.tables)
        return sum(o.size for files_ in everything for o in files_.values())

    @contextmanager
    def writing(
        self, recording: str, name: str = "", *, wait_s: float = 0.0, records: bool = False
    ) -> Iterator[None]:
        """A change of a recording, which counts at the end of the block.

        Raises:
            StoreError: This process would record.
            TopicError: The recording is gone.
            ObjectExistsError: Another process was faster: begin again.
        """
        if records:
            self.check_writable()
        with self.changing():
            if recording not in self._now.recordings:
                raise gone(name or recording)
            yield

    @contextmanager
    def changing(self) -> Iterator[None]:
        """A change of the store, which counts at the end of the block, or of the outer one.

        Raises:
            ObjectExistsError: Another process was faster: begin again.
        """
        self.check_changes()
        with self.source.lock:
            if self.source.is_changing:
                yield
                return
            self.source.look(self.settings.store_id, now=True)
            before = self._now
            self._cells.begin()
            self.source.is_changing = True
            try:
                yield
                if self._now is not before:
                    self.source.commit(before, replace(self._now, catalog=self._cells.to_bytes()))
            except BaseException:
                if self._now.number == before.number:
                    self.source.list = before
                raise
            finally:
                self.source.is_changing = False
                self._cells.end()

    def check_changes(self) -> None:
        """Raise if the store was opened for reading only."""
        if self.read_only:
            raise StoreError(f"The store {self.place} was opened for reading only.")

    def change(self, recording: str, how: Callable[[Manifest], Manifest]) -> Manifest:
        """See `ListedManifests.change`."""
        with self.changing():
            if recording not in self._now.recordings:
                raise RecordingGoneError(f"There is no recording {recording!r}.")
            now = self._manifest(recording)
            made = how(now)
            if made == now:
                return now
            made = truth.replace(made, id=now.id, created=now.created, changes=now.changes + 1)
            self._list_manifest(recording, made)
            return made

    def _manifest(self, recording: str) -> Manifest:
        found = self.manifests.find(recording)
        if found is None:
            raise ManifestError(
                f"{self.recording(recording)} has lost its manifest: `hybridlog copy` brings it "
                "back."
            )
        return found

    def _list_manifest(self, recording: str, manifest: Manifest) -> None:
        data = encode(manifest)
        name = other_name(f"{RECORDINGS}/{recording}/{MANIFEST}")
        about = Object(name, len(data), self.source.bucket.create(name, data), 0)
        self._relist(recording, {**self._now.recordings[recording], MANIFEST: about})

    @contextmanager
    def at_hand(self, recording: str, segments: Collection[int] = ()) -> Iterator[StoreDirectory]:
        """As of a directory; what the block leaves on the disk becomes objects.

        Raises:
            StoreError: An object that is needed is lost.
        """
        objects, bucket = self.files_of(recording), self.source.bucket
        manifest = self._manifest(recording)
        wanted = {manifest.logs[number].name for number in segments}
        if wanted:  # fields of expired messages belong to all segments
            wanted |= {path for path in objects if path.startswith(f"{PAYLOADS}/")}
        with tempfile.TemporaryDirectory(prefix="hybridlog-") as place:
            there = StoreDirectory.create(Path(place) / "store")
            folder = there.recording(recording)
            there.manifests.create(manifest)
            for path in wanted:
                try:
                    self.fetch(objects[path], folder / path)
                except (KeyError, FileNotFoundError, ObjectChangedError) as error:
                    raise StoreError(f"{self.recording(recording) / path} is lost.") from error
            before = _files_below(folder)
            yield there
            after = _files_below(folder)
            listed = dict(self._now.recordings[recording])
            for path, about in after.items():
                if before.get(path) != about:
                    name = f"{RECORDINGS}/{recording}/{path}"
                    with (folder / path).open("rb") as file:
                        pieces = iter(partial(file.read, _PIECE), b"")
                        listed[path] = bucket.send(name, about[0], pieces)
            for path in before.keys() - after.keys():
                del listed[path]
            self._relist(recording, listed)
            changed = there.manifests.read(recording)
            if changed != manifest:
                self._list_manifest(recording, changed)

    def fetch(self, about: Object, path: Path) -> None:
        """Write an object to a file, past the cache.

        Raises:
            FileNotFoundError: It does not exist.
            ObjectChangedError: It has another version.
            BucketError: The server does not answer, or refuses.
        """
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("wb") as file:
            for piece in self.source.bucket.pieces(about):
                file.write(piece)

    def refresh(self) -> None:
        """See what the newest list has."""
        self.source.look(self.settings.store_id, now=True)

    def files_of(self, recording: str) -> Mapping[str, Object]:
        """The object of each file of a recording, without those that are lost."""
        return self.source.files_of(recording)

    def lost_of(self, recording: str) -> dict[str, Object]:
        """The files of a recording, which is compared with its objects, that were lost.

        After `look_closely` its fields are among them, with `tables/` before their paths.
        """
        lost = self.source.bucket.lost
        self.source.compare(recording)
        mine = _tables_of(recording)
        tables = {f"{TABLES}/{p}": o for p, o in self._now.tables.items() if mine.fullmatch(p)}
        return {p: o for p, o in {**self._now.recordings[recording], **tables}.items() if o in lost}

    def add_recording(
        self, recording: str, found: Mapping[str, Object], tables: Mapping[str, Object]
    ) -> None:
        """List a recording whose objects are there, within `changing`."""
        self.source.bucket.lost.difference_update(found.values(), tables.values())
        self._relist(recording, found)
        self._replace_tables(recording, tables)

    def mend(
        self, recording: str, found: Mapping[str, Object], tables: Mapping[str, Object] | None
    ) -> None:
        """List objects of a recording in the place of lost ones, within `changing`.

        Args:
            recording: Its id.
            found: Its files that were lost.
            tables: All files of its fields; None to leave them as they are.
        """
        self.source.bucket.lost.difference_update(found.values(), (tables or {}).values())
        self._relist(recording, {**self._now.recordings[recording], **found})
        if tables is not None:
            self._replace_tables(recording, tables)

    def drop(self, recording: str) -> None:
        """List a recording no more, within `writing`; its objects stay."""
        others = dict(self._now.recordings)
        del others[recording]
        self.source.list = replace(self._now, recordings=others)
        self._replace_tables(recording, {})

    def unneeded(self, now: int | None = None) -> list[Object]:
        """Objects that may be deleted: what neither a list of the last hour nor a copy needs.

        Args:
            now: The time, ns; None for the server's.

        Raises:
            StoreError: A list is damaged.
            BucketError: The server does not answer, or refuses.
        """
        bucket = self.source.bucket
        now = bucket.now() if now is None else now
        self.refresh()
        found = [one for one in bucket.objects() if one.name != SETTINGS]
        lists = [one for one in found if number_of(one.name) is not None]
        newest = next((n for n, one in enumerate(lists) if one.name == self._listed), None)
        if newest is None:
            return []
        # A list was the newest until the one after it was created.
        kept = [
            one
            for n, one in enumerate(lists)
            if n <= newest or now - lists[n - 1].modified < _READ_NS
        ]
        named = {one.name for one in kept}
        for one in kept:
            listed = self.source.read_list(self.settings.store_id, one)
            named.update(o.name for r in listed.recordings.values() for o in r.values())
            named.update(o.name for o in listed.tables.values())
        old = {one.name for one in lists}
        return [
            one
            for one in found
            if one.name not in named
            and (one.name in old or now - one.modified > UNLISTED_DAYS * _DAY_NS)
        ]

    @property
    def _listed(self) -> str:
        return list_name(self._now.number)

    def _replace_tables(self, recording: str, tables: Mapping[str, Object]) -> None:
        mine = _tables_of(recording)
        others = {path: o for path, o in self._now.tables.items() if not mine.fullmatch(path)}
        self.source.list = replace(self._now, tables={**others, **tables})

    def _relist(self, recording: str, found: Mapping[str, Object]) -> None:
        recordings = {**self._now.recordings, recording: found}
        self.source.list = replace(self._now, recordings=recordings)


def _tables_of(recording: str) -> re.Pattern[str]:
    """The paths of the fields of a recording, below `tables`."""
    return re.compile(rf"[^/]+/{recording}-\d+\.parquet")


def _files_below(folder: Path) -> dict[str, tuple[int, int]]:
    """Size and inode of the files of a recording, by path; without its manifest and locks."""
    found = {}
    for path in folder.rglob("[!.]*"):
        if path.is_file() and path.name not in _NOT_LISTED:
            about = path.stat()
            found[path.relative_to(folder).as_posix()] = about.st_size, about.st_ino
    return found


def _folder(objects: Mapping[str, Object]) -> dict[str, Any]:
    """Files below a folder."""
    found: dict[str, Any] = {}
    for path, about in objects.items():
        *folders, name = path.split("/")
        place = found
        for part in folders:
            place = place.setdefault(part, {})
            if not isinstance(place, dict):
                raise StoreError(f"The list names {path!r} both as a file and as a folder.")
        place[name] = about
    return found


def _look(objects: Mapping[str, Object]) -> str:
    digest = hashlib.sha256()
    for path, one in sorted(objects.items()):
        digest.update(f"{path}\n{one.name}\n{one.size}\n{one.version}\n".encode())
    return f"0 0 0 {digest.hexdigest()[:32]} 0 0 0"


def _stat(mode: int, inode: int, size: int, changed: int = 0) -> os.stat_result:
    plain = (mode, inode, 0, 1, os.getuid(), os.getgid(), size, 0, 0, 0)
    times = {"st_atime_ns": 0, "st_mtime_ns": changed, "st_ctime_ns": 0}
    return os.stat_result(plain, times)
