"""A store in a bucket, as a directory that others read.

Its objects have the names of the files of a directory. A recording is its manifest, as this
process has seen it last, and the files that it lists; nobody asks which others there are. It has no
tables: messages answer, which are fetched once, and rows.

The catalog lies in the user's cache, and has manifests with their versions: an opening reads those
that have changed since the last one.
"""

from __future__ import annotations

import errno
import secrets
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import ClassVar, Final, cast

from msgspec.structs import replace

from hybridlog_storage.cells import Cells, cells_of_user, drop, put
from hybridlog_storage.copy import RefusedError, Sending, Source
from hybridlog_storage.disk import files
from hybridlog_storage.disk.directory import (
    Listing,
    StoreDirectory,
    gone,
)
from hybridlog_storage.errors import (
    ExistsError,
    ObjectChangedError,
    RecordingGoneError,
    StoreError,
)
from hybridlog_storage.manifest import (
    MAX_BYTES,
    Manifest,
    digest_of,
    encode,
)
from hybridlog_storage.manifests import MANIFESTS, RECORDINGS, Manifests, decoded, ids_of
from hybridlog_storage.remote.bucket import BlockCache, Bucket, Object
from hybridlog_storage.settings import MAX_SETTINGS, NONE, StoreSettings, settings_of, settings_text
from hybridlog_storage.settings import NAME as SETTINGS

LOOK_EVERY_S: Final = 5.0
"""Seconds between two looks for changes of others, for each thousand recordings."""
_MANIFEST: Final = "manifest"
"""Kind of the cells, by recording, of its manifest with its version."""
_PARALLEL: Final = 16
_FETCHED: Final = 8 << 20  # bytes that a copy asks for at once


class BucketManifests(Manifests):
    """The manifests of a bucket as they were at the last look; a change asks for the newest.

    `objects` are by id; `number` counts what others have changed at a look, and what came or went
    here.
    """

    cure = "If it is deleted, `hybridlog copy` from a store that has it brings it back."

    def __init__(self, bucket: Bucket, cells: Cells) -> None:
        self.objects: dict[str, Object] = {}
        self.number = 0
        self.place, self._bucket, self._cells = bucket.address, bucket, cells
        self._known: dict[str, tuple[Manifest, str]] = {}
        self._look_at = 0.0
        self._lock = threading.RLock()

    def look(self, *, now: bool = False) -> None:
        """See what others have changed, `now` or if the last look is a while ago."""
        with self._lock:
            if self.number and not now and time.monotonic() < self._look_at:
                return
            found = {one.name: one for one in self._bucket.objects(f"{MANIFESTS}/")}
            ids = ids_of(name.removeprefix(f"{MANIFESTS}/") for name in found)
            before, self.objects = self.objects, {one: found[_name_of(one)] for one in ids}
            changed = {
                one
                for one in before.keys() | self.objects.keys()
                if _version(before.get(one)) != _version(self.objects.get(one))
            }
            if changed or not self.number:
                self.number += 1
                self._fetch(changed & self.objects.keys())
            self._look_at = time.monotonic() + LOOK_EVERY_S * (1 + len(found) // 1000)

    def _fetch(self, changed: Collection[str]) -> None:
        """Read manifests that the catalog does not have, several at once."""
        known = self._cells.each(_MANIFEST, changed) if changed else {}
        heads = {one: f"{self.objects[one].version}\n".encode() for one in changed}
        new = [one for one in changed if not known.get(one, b"").startswith(heads[one])]

        def read(recording: str) -> tuple[Object, bytes] | None:
            with suppress(FileNotFoundError):  # it was removed just now
                return self._bucket.read_whole(_name_of(recording), MAX_BYTES)
            return None

        with ThreadPoolExecutor(_PARALLEL) as pool:
            for recording, found in zip(new, pool.map(read, new), strict=True):
                if found is not None:
                    self._note(recording, found[1], found[0].version)

    def ids(self) -> list[str]:
        """Ids of all recordings, sorted; also of those being removed."""
        self.look()
        return sorted(self.objects)

    def remove(
        self, recording: str, check: Callable[[Manifest], object] = lambda _: None
    ) -> Manifest:
        """Remove a recording with all its objects, and those of others whose removal was cut."""
        removed = super().remove(recording, check)
        for one in self.ids():
            with suppress(StoreError):  # it is told where it is asked about
                if self._seen(one)[0].status == "removed":
                    super().remove(one)
        return removed

    def _seen(self, recording: str) -> tuple[Manifest, str]:
        with self._lock:
            version, known = _version(self.objects.get(recording)), self._known.get(recording)
            if known is None or known[1] != version:
                noted, _, data = (self._cells.read(_MANIFEST, recording) or b"").partition(b"\n")
                known = None
                if noted == version.encode():
                    with suppress(ValueError):
                        known = decoded(recording, data), version
            self._known[recording] = known or self._read(recording)
            return self._known[recording]

    def _get(self, recording: str) -> tuple[bytes, str]:
        about, data = self._bucket.read_whole(_name_of(recording), MAX_BYTES)
        self._note(recording, data, about.version)
        return data, about.version

    def _create(self, manifest: Manifest) -> None:
        data = encode(manifest)
        version = self._bucket.create(_name_of(manifest.id), data)
        self._note(manifest.id, data, version)

    def _replace(self, recording: str, data: bytes, version: str) -> None:
        version = self._bucket.replace(_name_of(recording), data, version)
        self._note(recording, data, version)

    def _note(self, recording: str, data: bytes, version: str) -> None:
        with self._lock:
            self.number += recording not in self.objects
            self.objects[recording] = Object(_name_of(recording), len(data), version)
            self._known.pop(recording, None)
            self._cells.write([put(_MANIFEST, recording, version.encode() + b"\n" + data)])

    def _delete_files(self, recording: str) -> None:
        names = [one.name for one in self._bucket.objects(f"{RECORDINGS}/{recording}/")]
        self._bucket.delete(names)

    def _forget(self, recording: str, *, says_so: bool) -> None:
        # Servers have no condition for deletions: between these two it could be created anew.
        with suppress(RecordingGoneError):
            if self._read(recording)[0].status != "removed":
                return
            self._bucket.delete([_name_of(recording)])
        with self._lock:
            self._known.pop(recording, None)
            self.objects.pop(recording, None)
            self.number += 1
            self._cells.write([drop(_MANIFEST, recording)])


class BucketStore(Source):
    """A store in a bucket; one for all who use it in this process, by its path: `files.mounted`.

    `cells` are those of its catalog.
    """

    manifests: BucketManifests

    def __init__(self, bucket: Bucket) -> None:
        self.bucket, self.address = bucket, bucket.address
        self.cache = BlockCache()
        self.cells = cells_of_user(self.address, self.address)
        self.manifests = BucketManifests(bucket, self.cells)
        self._found: dict[str, Object] = {}

    def open(self, inner: tuple[str, ...]) -> int:
        """A handle for reading a file that a manifest lists."""
        about = None
        if len(inner) == 3 and inner[0] == RECORDINGS:
            with suppress(RecordingGoneError):
                listed = objects_of(self.manifests.read(inner[1]))
                about = next((one for one in listed if one.name == "/".join(inner)), None)
        if about is None:
            place = "/".join([self.address, *inner])
            raise FileNotFoundError(errno.ENOENT, "there is no such object", place)
        return self.cache.open(self.bucket, about)

    def sizes(self, folder: str) -> dict[str, int]:
        """As of `Place`; 1,000 a request."""
        found = {one.name: one for one in self.bucket.objects(f"{folder}/")}
        self._found |= found
        return {name.removeprefix(f"{folder}/"): one.size for name, one in found.items()}

    def send(self, sent: Sending) -> None:
        """As of `Place`; from its first byte on."""
        self._found[sent.name] = self.bucket.put(sent.name, sent.size, sent.pieces())
        if not self.has(sent.name, sent):
            raise sent.not_arrived(self)

    def has(self, name: str, sent: Sending) -> bool:
        """As of `Place`: by the checksum of the server, or it is read."""
        if self._found[name].has_md5_of(sent.again()):
            return True
        with suppress(RefusedError):
            return digest_of(self.pieces(name, 0, sent.size)) == sent.digest
        return False

    def drop(self, name: str) -> None:
        """As of `Place`."""
        self.bucket.delete([name])

    def pieces(self, name: str, at: int, size: int) -> Iterator[bytes]:
        """As of `Source`."""
        where = f"{self.address}/{name}"
        for begin in range(at, size, _FETCHED):
            try:
                yield self.bucket.read(name, begin, min(begin + _FETCHED, size), size)
            except FileNotFoundError as error:
                self.manifests.look(now=True)  # it may have expired meanwhile
                raise RefusedError(f"{where} cannot be copied: {error.strerror}.") from error
            except ObjectChangedError as error:
                raise RefusedError(f"{where} is damaged: it has not {size} bytes.") from error


def mount(address: str) -> BucketStore:
    """The store in a bucket."""
    found = files.mounted.get(Path(address)) or BucketStore(Bucket(address))
    return cast("BucketStore", files.mounted.setdefault(Path(address), found))


def objects_of(manifest: Manifest) -> Iterator[Object]:
    """The objects of the files that a manifest lists."""
    place = f"{RECORDINGS}/{manifest.id}"
    return (Object(f"{place}/{o.name}", o.bytes, o.digest) for o in manifest.present.values())


class RemoteDirectory(StoreDirectory):
    """A store in a bucket, `s3://lab/store`: read like a directory, changed by its manifests."""

    is_remote: ClassVar[bool] = True
    is_writable = False  # nothing is mended, or noted for others, without being asked to

    def __init__(self, address: str, *, read_only: bool = False) -> None:
        self.source = mount(address)
        self.place = self.address = address
        self.bucket = self.source.bucket
        self.path, self.read_only = Path(address), read_only
        self.recordings = self.path / RECORDINGS
        self.when_empty = f"The store is empty: `hybridlog copy {address}` fills it from a disk."
        try:
            _, content = self.bucket.read_whole(SETTINGS, MAX_SETTINGS)
        except FileNotFoundError as error:
            raise StoreError(
                f"There is no store at {self.place}. `hybridlog copy {self.place}` makes one from "
                "a store on a disk."
            ) from error
        # No server that a bucket names is asked.
        self.settings = replace(settings_of(content, self.place), mongo=NONE)
        self.manifests: BucketManifests = self.source.manifests
        self.manifests.look(now=True)

    @property
    def cells(self) -> Cells:
        """Those of the manifests, in the user's cache."""
        return self.source.cells

    @classmethod
    def create_in(cls, address: str) -> RemoteDirectory:
        """The store at an address; made if there is none."""
        with suppress(ExistsError):  # it is there, or another process makes it, too
            new = StoreSettings(secrets.token_hex(16), mongo=NONE)
            mount(address).bucket.create(SETTINGS, settings_text(new))
        return cls(address)

    def check_writable(self) -> None:
        """Raise: files are not written here one by one."""
        raise StoreError(
            f"{self.place} is a store in a bucket, where this cannot be done. Do it in a store on "
            "a disk, and bring that here with `hybridlog copy`."
        )

    def check_changes(self) -> None:
        """Raise if the store was opened for reading only."""
        if self.read_only:
            raise StoreError(f"The store {self.place} was opened for reading only.")

    def changed(self) -> int:
        """A number that changes with what is seen of the store."""
        self.manifests.look()
        return self.manifests.number

    def looks(self, ids: Sequence[str]) -> dict[str, str]:
        """The look of each recording, by id: the version of its manifest."""
        known = self.manifests.objects
        return {one: known[one].version for one in ids if one in known}

    def look_closely(self, recording: str) -> None:
        """Have the objects of a recording read from the server again."""
        with suppress(StoreError):  # it is named where it is asked about
            for about in objects_of(self.manifests.read(recording)):
                self.source.cache.forget(self.bucket, about)

    def listing(self, recording: str) -> Listing:
        """As of a directory: what the manifest lists."""
        look, manifest = self.looks([recording]), self.manifests.read(recording)
        sealed = {n: one.name for n, one in sorted(manifest.logs.items()) if one.is_here}
        sizes = {name: one.bytes for name, one in manifest.present.items()}
        return Listing(sealed, {}, (), sizes, look.get(recording, ""))

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
        """Nothing is locked: a change is made of the newest manifest, and made again."""
        self.check_changes()
        if makes:
            self.check_writable()
        if recording not in self.manifests.objects:
            raise gone(name or recording)
        yield


def _version(about: Object | None) -> str:
    return "" if about is None else about.version


def _name_of(recording: str) -> str:
    return f"{MANIFESTS}/{recording}.json"
