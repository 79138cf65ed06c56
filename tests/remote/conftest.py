"""A bucket for each test, and the proxy before it."""

from __future__ import annotations

import secrets
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import hybridlog as hl
from hybridlog_storage.disk import files
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.remote.server import Moto, Proxy, make_bucket

SECOND = 10**9
BEGIN = 1_700_000_000 * SECOND
ARM = Channel("/arm", "ros1", Schema("a/Arm", "ros1msg", b"uint32 n\nfloat64 x\n"), {})
SCAN = Channel("/scan", "ros1", Schema("a/Scan", "ros1msg", b"uint32 n\nfloat32[] ranges\n"), {})
RECORDINGS = ("run", "more", *(f"short-{number}" for number in range(3)))


@pytest.fixture(scope="session")
def moto(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Moto]:
    server = Moto(tmp_path_factory.mktemp("moto") / "log")
    yield server
    server.close()


@pytest.fixture(scope="session")
def running_proxy(moto: Moto) -> Iterator[Proxy]:
    found = Proxy(moto.port)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ACCESS_KEY_ID", "tester")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "tester")
        patch.setenv("AWS_REGION", "us-east-1")
        patch.setenv("AWS_ALLOW_HTTP", "true")
        patch.setenv("AWS_ENDPOINT_URL", found.url)
        yield found
    found.close()


@pytest.fixture
def proxy(running_proxy: Proxy, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Proxy:
    """As a new process finds it, without a cache."""
    running_proxy.reset()
    files.mounted.clear()
    monkeypatch.setenv("AWS_ENDPOINT_URL", running_proxy.url)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return running_proxy


@pytest.fixture
def address(proxy: Proxy) -> str:
    """The address of an empty place in a bucket."""
    return new_address(proxy)


def new_address(proxy: Proxy) -> str:
    proxy.reset()
    name = f"lab-{secrets.token_hex(4)}"
    make_bucket(proxy.url, name)
    proxy.reset()
    return f"s3://{name}/store"


@pytest.fixture(scope="session")
def here(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store on the disk: long recordings and short ones."""
    path = tmp_path_factory.mktemp("here") / "store"
    noise = np.random.default_rng(1)
    settings = SegmentSettings(chunk_size=4096, segment_size=400_000)
    with hl.open(path, mongo="none", create=True) as store:
        for place, name in enumerate(RECORDINGS):
            recording = store.start(name, settings=settings)
            count = 400 if name in {"run", "more"} else 20
            for number in range(count):
                at = BEGIN + (place * 1000 + number) * SECOND // 10
                scan = struct.pack("<II", number, 500) + noise.random(500, np.float32).tobytes()
                recording.write(SCAN, scan, log_time=at)
                recording.write(ARM, struct.pack("<Id", number, number / 2), log_time=at + 1)
            recording.close()
        store.edit("run", tag={"place": "lab"})
        store.mark("run", "+1s", "slipped", {"trigger": "bump"})
    return path


def publish_all(here: Path, address: str, names: tuple[str, ...] = RECORDINGS) -> None:
    with hl.open(here, mongo="none") as store:
        assert sorted(store.copy(address, [*names]).copied) == sorted(names)
    files.mounted.clear()


@pytest.fixture(scope="session")
def published_once(
    here: Path, running_proxy: Proxy, tmp_path_factory: pytest.TempPathFactory
) -> str:
    address = new_address(running_proxy)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        publish_all(here, address)
    return address


@pytest.fixture
def published(published_once: str, proxy: Proxy) -> str:
    """The same store in a bucket. Tests do not change it."""
    return published_once
