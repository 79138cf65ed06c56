"""Stores with recordings made by hand, and places to copy them to."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pytest
from blake3 import blake3

from hybridlog_storage.copy_places import BucketStore, Directory, Place, Source
from hybridlog_storage.manifest import Channel, File, Loss, Manifest, Part, Pin, new_id, replace
from hybridlog_storage.remote.bucket import Bucket
from hybridlog_storage.sftp import Server
from tests.manifest_copies.server import Sshd
from tests.remote.conftest import address, moto, new_address, proxy, running_proxy
from tests.remote.server import Proxy

__all__ = ["address", "moto", "proxy", "running_proxy"]

PAIRS = [
    ("directory", "directory"),
    ("directory", "bucket"),
    ("directory", "shell"),
    ("directory", "sftp"),
    ("bucket", "directory"),
]
MORE_PAIRS = [*PAIRS, ("bucket", "bucket"), ("bucket", "shell")]
_DEFINITION = b"uint32 n\nfloat32[] ranges\n"
SCHEMA = blake3(_DEFINITION).hexdigest()
SIZES = {
    "000000.mcap": 3000,
    "000001.large.mcap": 200_000,
    "000002.front.mcap": 350_000,
    "000002.rows.parquet": 1000,
    "000003.mcap": 2000,
    "000004.large.mcap": 150_000,
}
FIRST = ("000000.mcap", "000002.rows.parquet", "000003.mcap")
"""What is sent of it with `only_fields`."""


def bytes_of(name: str) -> bytes:
    return random.Random(name).randbytes(SIZES[name])


def listed(name: str) -> File:
    content, number = bytes_of(name), int(name[:6])
    return File(
        number,
        0 if number < 3 else 3,
        name,
        "rows" if name.endswith("parquet") else "log",
        len(content),
        blake3(content).hexdigest(),
        1,
        parts={0: Part(10, len(content))},
    )


def recording(count: int = len(SIZES), status: str = "complete") -> Manifest:
    """One with the first files."""
    names = [*SIZES][:count]
    channel = Channel("/scan", "ros1", "a/Scan", SCHEMA, messages=10 * count, bytes=100 * count)
    return Manifest(
        RECORDING,
        "run",
        1,
        tags={"a": "b"},
        pins=(Pin("0" * 16),),
        channels={0: channel},
        files=tuple(map(listed, names)),
        losses=(Loss("transport", count=count),),
        status=status,  # type: ignore[arg-type]
    )


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
        self.write(f"schemas/{SCHEMA}", _DEFINITION)
        for file in manifest.files:
            self.write(f"recordings/{manifest.id}/{file.name}", bytes_of(file.name))
        self.place.manifests.create(manifest)

    def write(self, name: str, content: bytes) -> None:
        if self.bucket is not None:
            self.bucket.put(name, len(content), [content])
            return
        assert self.folder is not None
        (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
        (self.folder / name).write_bytes(content)

    def read(self, name: str) -> bytes:
        if self.bucket is not None:
            return self.bucket.read_whole(name, 1 << 30)[1]
        assert self.folder is not None
        return (self.folder / name).read_bytes()

    def delete(self, name: str) -> None:
        if self.bucket is not None:
            self.bucket.delete([name])
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
        for file in found.files:
            if file.is_here:
                content = self.read(f"recordings/{RECORDING}/{file.name}")
                assert blake3(content).hexdigest() == file.digest, file.name
        for channel in found.channels.values():
            assert blake3(self.read(f"schemas/{channel.schema}")).hexdigest() == channel.schema
        if wanted is not None:
            assert replace(found, changes=0) == replace(wanted, changes=0)
            assert [name for name in self.names() if name.endswith(".part")] == []
        return found

    def is_there(self) -> bool:
        return RECORDING in self.manifests().ids()

    def manifests(self):  # type: ignore[no-untyped-def]
        """Read on the machine of the server itself."""
        return self.place.manifests if self.folder is None else Directory(self.folder).manifests


@pytest.fixture(scope="session")
def sshd(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Sshd]]:
    found = {kind: Sshd(tmp_path_factory.mktemp("sshd"), kind) for kind in ("shell", "sftp")}
    yield found
    for one in found.values():
        one.close()


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
                (folder / "hybridlog.toml").touch()
                return Store(Directory(folder), folder, None)
            server: Sshd = request.getfixturevalue("sshd")[kind]
            server.reset()
            return Store(held.enter_context(Server(server.url(folder), server.ssh)), folder, None)

        yield one


@pytest.fixture(params=PAIRS, ids="-".join)
def pair(request: pytest.FixtureRequest, make: Makes) -> tuple[Store, Store]:
    """A store with a recording, and an empty one."""
    source, target = map(make, request.param)
    source.begin(recording())
    return source, target
