"""The client of buckets, against a server that fails."""

from __future__ import annotations

import random

import pytest

from hybridlog_storage.errors import (
    BucketError,
    ExistsError,
    ObjectChangedError,
    UsageError,
)
from hybridlog_storage.remote.bucket import Bucket
from tests.limits import Limit
from tests.remote.server import Proxy

DATA = random.Random(1).randbytes(300_000)


def test_create_replace_read_delete(address: str, proxy: Proxy) -> None:
    bucket = Bucket(address)
    version = bucket.create("a/one", DATA)
    assert bucket.create("a/one", DATA) == version
    with pytest.raises(ExistsError):
        bucket.create("a/one", DATA[1:])
    bucket.delete(["a/one"])
    assert bucket.create("a/one", DATA[::-1]) != version
    with pytest.raises(ObjectChangedError):
        bucket.replace("a/one", b"1", version)
    with pytest.raises(ObjectChangedError):
        bucket.read("a/one", 0, 1, len(DATA) - 1)
    bucket.create("a/two", b"2")
    bucket.create("b", b"3")
    assert [(o.name, o.size) for o in bucket.objects("a")] == [("a/one", len(DATA)), ("a/two", 1)]
    assert [o.name for o in bucket.objects()] == ["a/one", "a/two", "b"]
    proxy.reset()
    assert bucket.read("a/one", 10, 20, len(DATA)) == DATA[::-1][10:20]
    assert len(proxy.requests) == 1
    assert bucket.read_whole("a/one", 1000)[1] == DATA[::-1][:1001]
    bucket.delete(["a/one", "a/one"])
    with pytest.raises(FileNotFoundError):
        bucket.read("a/one", 0, 1, len(DATA))


def test_large_objects_go_in_parts(address: str, proxy: Proxy, limit: Limit) -> None:
    limit(bucket_whole_bytes=200_000, bucket_part_bytes=100_000)
    bucket, data = Bucket(address), DATA[:250_000]

    first = bucket.put(
        "large", len(data), [data[at : at + 30_000] for at in range(0, 250_000, 30_000)]
    )
    assert sum("uploadId" in name for _, name, _ in proxy.requests) > 3
    assert bucket.objects() == [first]
    for size in (100_000, 50_000):
        assert first.has_md5_of(data[at : at + size] for at in range(0, len(data), size))
    assert not first.has_md5_of([data[1:]])


@pytest.mark.parametrize("first", range(3))
def test_spoiled_requests_are_repeated(address: str, proxy: Proxy, first: int) -> None:
    kinds = ("reset", "lost", "503", "cut", "slow")
    proxy.spoil = lambda number: kinds[number // 3 % 5] if number % 3 == first else ""
    bucket = Bucket(address)
    versions = [bucket.create(f"a/{n}", DATA[n:]) for n in range(3)]
    assert [o.version for o in bucket.objects("a")] == versions
    for _ in range(3):
        assert bucket.read("a/2", 200_000, 250_000, len(DATA) - 2) == DATA[200_002:250_002]
    assert bucket.read_whole("a/1", 1 << 20)[1] == DATA[1:]


def test_addresses_and_refusals(proxy: Proxy, limit: Limit) -> None:
    for wrong in ("s3://", "http://lab/store", "/a"):
        with pytest.raises(UsageError):
            Bucket(wrong)
    with pytest.raises(BucketError, match="There is no bucket"):
        Bucket("s3://nobody-has-this/store").read("a", 0, 1, 1)
    proxy.spoil = lambda _: "503"
    limit(bucket_retry_s=0)
    with pytest.raises(BucketError, match="nobody-has-this/store/a"):
        Bucket("s3://nobody-has-this/store").read("a", 0, 1, 1)
