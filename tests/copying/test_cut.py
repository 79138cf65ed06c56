"""Copies that are cut at any byte or request, and go on."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest

from hybridlog_storage.copy import copy
from hybridlog_storage.errors import HybridlogError
from hybridlog_storage.remote.bucket import Bucket
from hybridlog_storage.remote.store import BucketStore
from tests.copying.by_hand import RECORDING, TOTAL, Makes, Store, recording
from tests.copying.server import Sshd
from tests.copying.test_any_place import edited
from tests.limits import Limit
from tests.remote.server import Proxy
from tests.some import each


class CutError(Exception):
    """The connection has ended."""


def resumed(
    source: Store, target: Store, cut: Callable[[], None], heal: Callable[[], None]
) -> None:
    """Copy until it is done, cut each time but the last."""
    for attempt in range(6):
        if attempt < 5:
            cut()
        left = TOTAL - arrived(target)
        try:
            copied = copy(source.source, target.place, RECORDING)
        except (HybridlogError, CutError):
            heal()
            if target.is_there():
                target.check()
            continue
        heal()
        target.check(recording())
        # None twice; a server may have taken more since.
        assert target.bucket is not None or copied.sent_bytes <= left
        return
    raise AssertionError


def arrived(target: Store) -> int:
    """Bytes of the files of the recording, also of those that were cut."""
    paths = [] if target.folder is None else (target.folder / "recordings").rglob("*0*.*")
    return sum(path.stat().st_size for path in [*paths])


@pytest.mark.parametrize("seed", [0, 1, *each(*range(2, 8))])
@pytest.mark.parametrize("kinds", [("directory", "directory"), ("bucket", "directory")])
def test_a_directory_goes_on_at_the_last_byte(
    make: Makes, kinds: tuple[str, str], seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng, (source, target) = random.Random(seed), map(make, kinds)
    source.begin(recording())
    real, sent = source.source.pieces, [0]
    left = 0

    def cut() -> None:
        nonlocal left
        left = rng.randrange(TOTAL // 2)

    def pieces(name: str, at: int, size: int | None):  # type: ignore[no-untyped-def]
        nonlocal left
        for piece in real(name, at, size):
            for begin in range(0, len(piece), 1000):
                part = piece[begin : begin + 1000][:left]
                left -= len(part)
                sent[0] += len(part) if name.startswith("recordings") else 0
                yield part
                if not left:
                    raise CutError

    def heal() -> None:
        nonlocal left
        left = 1 << 40

    monkeypatch.setattr(source.source, "pieces", pieces)
    resumed(source, target, cut, heal)
    assert sent[0] == TOTAL  # none twice


@pytest.mark.parametrize("seed", [0, 1, *each(*range(2, 6))])
def test_a_server_goes_on_at_the_last_byte(make: Makes, sshd: Sshd, seed: int) -> None:
    rng, server = random.Random(seed), sshd
    source, target = make("directory"), make("shell")
    source.begin(recording())

    def cut() -> None:
        server.left = rng.randrange(10_000, TOTAL)

    resumed(source, target, cut, server.reset)


@pytest.mark.parametrize("seed", [0, 1, *each(*range(2, 6))])
@pytest.mark.parametrize("kinds", [("directory", "bucket"), ("bucket", "directory")])
def test_a_bucket_that_is_cut_at_any_request(
    make: Makes, proxy: Proxy, kinds: tuple[str, str], seed: int, limit: Limit
) -> None:
    limit(bucket_retry_s=0, bucket_whole_bytes=100_000, bucket_part_bytes=50_000)
    rng, (source, target) = random.Random(seed), map(make, kinds)
    source.begin(recording())
    first = 0

    def cut() -> None:
        nonlocal first
        first, what = rng.randrange(1, 25), rng.choice(["reset", "lost", "503", "cut"])
        proxy.reset()
        proxy.spoil = lambda number: what if number >= first else ""

    resumed(source, target, cut, proxy.reset)


def test_requests_to_a_bucket(make: Makes, proxy: Proxy) -> None:
    source, target = make("directory"), make("bucket")
    source.begin(recording())
    copy(source.source, target.place, RECORDING)
    assert target.bucket is not None
    proxy.reset()
    copy(source.source, BucketStore(Bucket(target.bucket.address)), RECORDING)
    assert len(proxy.requests) <= 3
    proxy.reset()
    BucketStore(Bucket(target.bucket.address)).manifests.change(RECORDING, edited)
    assert len(proxy.requests) <= 4


def test_a_server_without_conditions_is_refused_before_the_first_write(
    make: Makes, proxy: Proxy
) -> None:
    source, target = make("directory"), make("bucket")
    source.begin(recording())
    assert target.bucket is not None
    proxy.without_conditions = True
    with pytest.raises(HybridlogError, match="ignores conditions"):
        copy(source.source, target.place, RECORDING)
    assert target.names() == []
    proxy.reset()
    copy(source.source, target.place, RECORDING)
    proxy.without_conditions = True
    before = target.manifests().read(RECORDING)
    with pytest.raises(HybridlogError, match="ignores conditions"):
        BucketStore(Bucket(target.bucket.address)).manifests.change(RECORDING, edited)
    assert target.manifests().read(RECORDING) == before
    assert [name for name in target.names() if "probe" in name] == []
