"""Stores with recordings made by hand, and places to copy them to."""

from __future__ import annotations

import random
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from blake3 import blake3

from hybridlog_storage.copy import Directory, Place, Source
from hybridlog_storage.manifest import (
    Channel,
    File,
    Loss,
    Manifest,
    Part,
    Pin,
    new_id,
    replace,
    with_rows,
)
from hybridlog_storage.remote.bucket import Bucket
from hybridlog_storage.remote.store import BucketStore
from hybridlog_storage.server import Server
from hybridlog_storage.settings import StoreSettings, write_settings
from tests.copying.server import Sshd
from tests.places import begin
from tests.remote.conftest import new_address
from tests.remote.server import Proxy

PAIRS = [("directory", "bucket"), ("directory", "shell"), ("bucket", "directory")]
SIZES = {
    "000000.mcap": 3000,
    "000001.mcap": 200_000,
    "000002.mcap": 350_000,
    "000004.mcap": 150_000,
    "000003.rows.parquet": 2000,
    "000003.1.rows.parquet": 1000,
    "000001.7.rows.parquet": 300,
    "000002.7.rows.parquet": 300,
    "000004.7.rows.parquet": 200,
    "000001.rows.parquet": 400,
    "000004.rows.parquet": 500,
}
NAMES = [*SIZES][:6]
"""Files of a whole recording, of which a log has expired."""
TOTAL = sum(SIZES[name] for name in NAMES)
FIRST = ["000000.mcap", *[*SIZES][4:9]]
"""What is sent of it if payloads are left for later."""


def bytes_of(name: str) -> bytes:
    return random.Random(name).randbytes(SIZES[name])


def listed(name: str) -> File:
    content, number = bytes_of(name), int(name[:6])
    return File(
        number,
        number,
        name,
        "log" if name.endswith(".mcap") else "rows",
        len(content),
        blake3(content).hexdigest(),
        1,
        parts={0: Part(10, 20, 1, 2)},
    )


def recording(count: int = 5, status: str = "complete") -> Manifest:
    """One with the first logs."""
    channel = Channel("/scan", "ros1", "a/Scan", messages=10 * count, bytes=100 * count)
    files = {int(name[:6]): listed(name) for name in NAMES[:4]}
    gone = File(3, 3, "000003.mcap", "log", 1, "3" * 64, 1, parts=files[0].parts, gone="expired")
    logs = [{**files, 3: gone}[number] for number in range(count)]
    return Manifest(
        RECORDING,
        "run",
        1,
        tags={"a": "b"},
        pins=(Pin("0" * 16),),
        channels={0: channel},
        files=(*logs, *map(listed, NAMES[4:] if count > 3 else ())),
        losses=(Loss("transport", count=count),),
        status=status,  # type: ignore[arg-type]
    )


@contextmanager
def without_payloads(now: Manifest, logs: list[File]) -> Iterator[tuple[Manifest, Source]]:
    """What is sent of a recording whose payloads are to come later."""
    with tempfile.TemporaryDirectory() as place:
        store = Store(Directory(Path(place)), Path(place), None)
        for log in logs:
            rows = f"{log.number:06d}.7.rows.parquet"
            if rows in FIRST and log.is_here:
                store.write(f"recordings/{now.id}/{rows}", bytes_of(rows))
                line = replace(log, gone="elsewhere", copy="s3://lab/store")
                now = with_rows(now, line, [listed(rows)])
        yield now, store.source


RECORDING = new_id("run")


@dataclass
class Store:
    """A store for tests: a place, and its folder on this machine or its bucket."""

    place: Place
    folder: Path | None
    bucket: Bucket | None

    @property
    def source(self) -> Source:
        assert isinstance(self.place, Source)
        return self.place

    def begin(self, manifest: Manifest) -> None:
        """Make a recording with all its files."""
        for name in manifest.present:
            self.write(f"recordings/{manifest.id}/{name}", bytes_of(name))
        begin(self.place.manifests, manifest)

    def write(self, name: str, content: bytes) -> None:
        if self.bucket is not None:
            self.bucket.put(name, len(content), [content])
            self.look()
            return
        assert self.folder is not None
        (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
        (self.folder / name).write_bytes(content)

    def look(self) -> None:
        """See what another process has changed in the bucket."""
        assert isinstance(self.place, BucketStore)
        self.place.manifests.look(now=True)

    def read(self, name: str) -> bytes:
        if self.bucket is not None:
            return self.bucket.read_whole(name, 1 << 30)[1]
        assert self.folder is not None
        return (self.folder / name).read_bytes()

    def delete(self, name: str) -> None:
        if self.bucket is not None:
            self.bucket.delete([name])
            self.look()
            return
        assert self.folder is not None
        (self.folder / name).unlink()

    def names(self) -> list[str]:
        """Names of all files that are visible."""
        if self.bucket is not None:
            return [one.name for one in self.bucket.objects()]
        assert self.folder is not None
        paths = [path for path in self.folder.rglob("*") if path.is_file()]
        return sorted(str(path.relative_to(self.folder)) for path in paths)

    def check(self, wanted: Manifest | None = None) -> Manifest:
        """The recording, whose files are there whole, and nothing else if it is as wanted."""
        found = self.manifests().read(RECORDING)
        paths = set()
        for file in found.present.values():
            path = f"recordings/{RECORDING}/{file.name}"
            assert blake3(self.read(path)).hexdigest() == file.digest, path
            paths.add(path)
        if wanted is not None:
            assert replace(found, changes=0) == replace(wanted, changes=0)
            there = {name for name in self.names() if name.startswith("recordings")}
            assert {name for name in there if not name.endswith((".lock", ".old"))} == paths
        return found

    def is_there(self) -> bool:
        return RECORDING in self.manifests().ids()

    def manifests(self):  # type: ignore[no-untyped-def]
        """Read on the machine of the server itself."""
        return self.place.manifests if self.folder is None else Directory(self.folder).manifests


@pytest.fixture(scope="session")
def sshd(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Sshd]:
    found = Sshd(tmp_path_factory.mktemp("sshd"))
    yield found
    found.close()


Makes = Callable[[str], Store]


@pytest.fixture
def make(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Makes]:
    """Makes an empty store of a kind."""
    with ExitStack() as held:

        def one(kind: str) -> Store:
            if kind == "bucket":
                proxy: Proxy = request.getfixturevalue("proxy")
                bucket = Bucket(new_address(proxy))
                return Store(BucketStore(bucket), None, bucket)
            folder = tmp_path / f'{kind} {len([*tmp_path.iterdir()])} it\'s "[*]"'
            if kind == "directory":
                (folder / "manifests").mkdir(parents=True)
                write_settings(folder, StoreSettings("0" * 32))
                return Store(Directory(folder), folder, None)
            server: Sshd = request.getfixturevalue("sshd")
            server.reset()
            place = held.enter_context(Server(server.url(folder), server.ssh))
            place.begin()
            return Store(place, folder, None)

        yield one


@pytest.fixture(params=PAIRS, ids="-".join)
def pair(request: pytest.FixtureRequest, make: Makes) -> tuple[Store, Store]:
    """A store with a recording, and an empty one, of the kinds that differ."""
    source, target = map(make, request.param)
    source.begin(recording())
    return source, target


@pytest.fixture
def directories(make: Makes) -> tuple[Store, Store]:
    """The same, of directories: for what does not depend on places."""
    source, target = make("directory"), make("directory")
    source.begin(recording())
    return source, target
