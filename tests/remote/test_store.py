"""A store in a bucket answers as the one on the disk, with few requests, or with an error."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import hybridlog as hl
from hybridlog_storage.cells import put
from hybridlog_storage.disk import files
from hybridlog_storage.errors import (
    HybridlogError,
    ResourceError,
    StoreError,
    UsageError,
)
from hybridlog_storage.remote import address_of
from hybridlog_storage.remote.bucket import BLOCK, BlockCache, Bucket
from hybridlog_storage.remote.store import RemoteDirectory
from tests.cli.within import answer
from tests.copies import bring
from tests.damage import flip
from tests.remote.conftest import BEGIN, RECORDINGS, SECOND, publish_all
from tests.remote.server import Proxy


def everything(store: hl.Store) -> dict[str, Any]:
    """Answers of all kinds."""
    return {
        "recordings": [
            (one.id, one.status, one.tags, one.manifest.notes, one.manifest.marks, one.messages)
            for one in store.recordings()
        ],
        "topics": store.topics(),
        "counts": [store.topic(topic).count() for topic in store.topics()],
        "where": store.topic("/arm").where("x > 20").count(),
        "arrays": store.topic("/scan").where("ranges.max > 0.999").count(),
        "messages": [
            (message.log_time_ns, message.topic, bytes(message.raw))
            for message in store.topic("/arm", "/scan")
        ],
        "fields": store.topic("/arm").where("n == 7").to_pandas().to_dict("list"),
        "sql": store.sql("select count(*), sum(x) from arm where n < 10").to_arrow().to_pylist(),
    }


@pytest.fixture(scope="session")
def expected(here: Path) -> dict[str, Any]:
    with hl.open(here, mongo="none") as store:
        return everything(store)


@pytest.mark.parametrize("is_spoiled", [False, True])
def test_answers_are_the_same(
    published: str, proxy: Proxy, expected: dict[str, Any], is_spoiled: bool
) -> None:
    kinds = ("reset", "cut", "503", "slow")
    if is_spoiled:
        proxy.spoil = lambda number: kinds[number // 4 % 4] if number % 4 == 3 else ""
    with hl.open(published) as store:
        assert everything(store) == expected
        assert str(store) == f"<Store {published}>"
    assert len(proxy.requests) > 9
    assert not any(method != "GET" for method, _, _ in proxy.requests)


def test_requests(published: str, proxy: Proxy) -> None:
    def asked(question: Callable[[], Any]) -> int:
        proxy.requests.clear()
        question()
        return len(proxy.requests)

    with hl.open(published) as store:
        assert len(proxy.requests) <= 3 + len(RECORDINGS)
        assert asked(store.recordings) == 0
        second = store.topic("/scan").between(BEGIN + 10 * SECOND, BEGIN + 11 * SECOND)
        assert asked(lambda: list(second)) <= 6
        assert asked(lambda: list(second)) == 0
        holding = store.topic("/arm").where("x > 5 and x < 50")
        assert asked(holding.count) <= 4 + 2 * len(RECORDINGS)
        assert asked(holding.count) == 0
    files.mounted.clear()  # another process has the cache, too
    proxy.requests.clear()
    with hl.open(published) as store:
        assert len(proxy.requests) <= 2
        assert asked(store.topic("/arm").where("x > 5 and x < 50").count) <= 1


def test_a_change_is_one_manifest(here: Path, address: str, proxy: Proxy) -> None:
    """Whoever opens the store then reads as little as before."""
    publish_all(here, address, ("run", "short-0"))
    names = {one.name for one in Bucket(address).objects()}
    for words in (
        ("tag", "run", "x=1"),
        ("edit", "run", "--note", "said"),
        ("mark", "seen", "-r", "run", "--at", "+2s"),
        ("keep", "--pin", "-r", "run"),
        ("edit", "run", "--name", "other"),
    ):
        files.mounted.clear()
        proxy.requests.clear()
        answer(*words, store=Path(address))
        made = [path for method, path, _ in proxy.requests if method == "PUT"]
        assert ["probe-" in path or "/manifests/" in path for path in made] == [True] * 2
        assert len(proxy.requests) <= 3 + 4
        assert {one.name for one in Bucket(address).objects()} == names
    files.mounted.clear()
    proxy.requests.clear()
    with hl.open(address) as store:
        assert len(proxy.requests) <= 3
        (entry,) = store.recordings(tag="place")
        now = entry.manifest
        assert (now.tags.get("x"), now.name, len(now.marks)) == ("1", "other", 2)
        assert now.notes
        assert now.pins
        assert not store.verify().findings


@pytest.mark.parametrize("left", [2, 1, 0])
def test_a_removal_deletes_all_objects(here: Path, address: str, proxy: Proxy, left: int) -> None:
    """Files first, then the manifest; the next removal finishes one that was cut."""
    publish_all(here, address, ("short-2", "short-0", "short-1"))
    with hl.open(address) as store:
        gone, other = store.entry("short-0").id, store.entry("short-1").id
        deletions = 0

        def cut(_: int) -> str:
            nonlocal deletions
            deletions += "?delete" in proxy.requests[-1][1]
            return "403" if left and deletions >= left else ""

        proxy.spoil = cut
        if left:
            with pytest.raises(HybridlogError, match="AWS_ACCESS_KEY_ID"):
                store.remove("short-0")
        else:
            store.remove("short-0")
    proxy.reset()
    files.mounted.clear()
    with hl.open(address) as store:
        assert gone not in {one.id for one in store.recordings()}
        store.remove("short-1")
        assert [one.name for one in store.recordings()] == ["short-2"]
    names = [one.name for one in Bucket(address).objects()]
    assert not [name for name in names if gone in name or other in name]


def lose(address: str, ending: str, recording: str = "", how: str = "goes") -> str:
    """Delete or change the last object whose name ends like this; its name."""
    bucket = Bucket(address)
    *_, name = (
        one.name for one in bucket.objects() if one.name.endswith(ending) and recording in one.name
    )
    data = bucket.read_whole(name, 1 << 30)[1]
    bucket.delete([name])
    if how == "grows":
        bucket.create(name, data + b"x")
    if how == "flips":
        middle = len(data) // 2
        bucket.create(name, data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :])
    return name


@pytest.mark.parametrize("how", ["goes", "grows"])
def test_lost_objects(here: Path, address: str, tmp_path: Path, how: str) -> None:
    publish_all(here, address, ("run", "short-0"))
    with hl.open(here, mongo="none") as source:
        run = source.entry("run").id
        whole = source.entry("run").messages // 2
    with hl.open(address) as store:
        assert store.topic("/scan").count() == whole + 20
        lose(address, "000001.mcap", run, how)
        with pytest.raises(StoreError, match=r"000001\.mcap .*is missing or was changed"):
            list(store.topic("/scan"))
    files.mounted.clear()
    with hl.open(address) as store:  # its end cannot be read: answers do without
        assert 0 < sum(1 for _ in store.topic("/scan")) - 20 < whole
        assert store.topic("/scan").completeness().has_losses
        (row,) = store.sql("select count(x) as n from arm").to_arrow().to_pylist()
        assert row["n"] == store.topic("/arm").count() == whole + 20
        found = store.verify()
        assert [(one.recording, one.place) for one in found.findings] == [("run", "000001.mcap")]
        assert "hybridlog copy" in found.findings[0].cure
        assert found.recordings == 2
    with hl.open(tmp_path / "back", mongo="none", create=True) as store:
        report = bring(store, address)
        assert (report.copied, [*report.refused]) == (["short-0"], ["run"])
        assert f"{run}/000001.mcap" in report.refused["run"]
    publish_all(here, address, ("run",))
    with hl.open(address) as store:
        assert store.topic("/scan").count() == whole + 20
        assert not store.verify().findings


def test_a_lost_manifest(here: Path, address: str, proxy: Proxy) -> None:
    publish_all(here, address, ("run", "short-0"))
    with hl.open(here, mongo="none") as source:
        run = source.entry("run").id
    lose(address, f"{run}.json")
    files.mounted.clear()
    with hl.open(address) as store:
        assert [one.name for one in store.recordings()] == ["short-0"]
    with hl.open(here, mongo="none") as source:
        assert not source.copy(address, ["run"]).refused
    files.mounted.clear()
    with hl.open(address) as store:
        assert not store.verify().findings
        assert store.topic("/arm").where("n < 10").count() == 20


def test_the_catalog_is_derived(
    published: str, proxy: Proxy, tmp_path: Path, expected: dict[str, Any]
) -> None:
    for harm in (Path.unlink, lambda path: flip(path, 1 / 2), Path.exists):
        files.mounted.clear()
        with hl.open(published) as store:
            assert everything(store) == expected
        (catalog,) = tmp_path.glob("cache/hybridlog/buckets/*.sqlite")
        harm(catalog)


def test_a_flipped_bit_is_found_whatever_the_cache_has(
    here: Path, address: str, proxy: Proxy
) -> None:
    publish_all(here, address, ("run", "short-0"))
    with hl.open(address) as store:
        assert not store.verify().findings
        lose(address, "000000.mcap", store.entry("run").id, "flips")
        findings = store.verify().findings
        assert {one.recording for one in findings} == {"run"}
        assert all("copy --check" in one.cure for one in findings)


def test_what_cannot_be_reached_is_told_in_words(
    here: Path, address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def told(ask: Callable[[], Any]) -> str:
        files.mounted.clear()
        with pytest.raises(HybridlogError) as caught:
            ask()
        assert caught.value.exit_code == 5
        return str(caught.value)

    none = "s3://no-bucket/store"
    with hl.open(here, mongo="none") as store:
        assert "There is no bucket 'no-bucket'" in told(lambda: store.copy(none, ["short-0"]))
    assert "There is no bucket 'no-bucket'" in told(lambda: hl.open(none))
    publish_all(here, address, ("short-0",))
    assert "a store in a bucket" in told(lambda: hl.open(address, require_database=True))
    with hl.open(address) as store:
        store.remove("short-0")
    assert f"`hybridlog copy {address}` fills it" in answer("ls", store=Path(address)).err
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    assert "http://127.0.0.1:9" in told(lambda: hl.open(address))
    monkeypatch.delenv("AWS_ALLOW_HTTP")
    assert "AWS_ALLOW_HTTP=true for one without TLS" in told(lambda: hl.open(address))


def test_hostile_catalogs(published: str, proxy: Proxy) -> None:
    with hl.open(published) as store:
        directory = store.directory
        assert isinstance(directory, RemoteDirectory)
        cells, (recording, *_) = directory.source.cells, directory.ids()
        manifest = cells.read("manifest", recording) or b""
        for body in (b"", b"x", manifest[:-9] + b"0" * 9, manifest.replace(b"run", b"fun")):
            cells.write([put("manifest", recording, body)])
            directory.manifests._known.clear()
            assert directory.manifests.read(recording).id == recording


def test_the_cache_heals_and_is_bounded(published: str, proxy: Proxy, tmp_path: Path) -> None:
    bucket = Bucket(published)
    about = max(bucket.objects("recordings"), key=lambda one: one.size)
    whole = bucket.read_whole(about.name, about.size)[1]
    cache = BlockCache(tmp_path / "blocks")
    handle = cache.open(bucket, about)
    proxy.requests.clear()
    assert files.pread(handle, 10, 0) == whole[:10]
    assert files.pread(handle, about.size, 0) == whole
    assert len(proxy.requests) == 2
    (data,) = (tmp_path / "blocks").glob("*.data")
    flip(data, 5)
    other = BlockCache(tmp_path / "blocks", BLOCK)  # of another process
    again = other.open(bucket, about)
    assert files.pread(again, about.size, 0) == whole
    assert not [*(tmp_path / "blocks").glob("*.data")]
    assert files.pread(handle, about.size, 0) == whole
    (tmp_path / "file").touch()
    with pytest.raises(ResourceError, match="XDG_CACHE_HOME"):
        BlockCache(tmp_path / "file").open(bucket, about)


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_forked_process_says_what_to_do(published: str, proxy: Proxy) -> None:
    with hl.open(published) as store:
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            said = []
            asks = {"open it here": store.topics, "spawn": lambda: hl.open(published)}
            for cure, ask in asks.items():
                try:
                    ask()
                except HybridlogError as error:
                    said.append(cure in str(error))
            os.write(writing, repr(said).encode())
            os._exit(0)
        os.waitpid(child, 0)
        assert os.read(reading, 100) == b"[True, True]"
        os.close(reading)
        os.close(writing)
        assert store.topic("/arm").count() == 860


def test_what_does_not_work_says_so(published: str, proxy: Proxy) -> None:
    with hl.open(published) as store:
        refused: list[Callable[[], Any]] = [
            lambda: store.index.arrays("/scan"),
            lambda: store.verify(repair=True),
            lambda: store.start("new"),
            lambda: store.keep({"quota": "1MB"}),
            lambda: store.keep({"quota": "1MB"}, dry_run=True),
        ]
        for change in refused:
            with pytest.raises(StoreError, match=r"is a store in a bucket.*hybridlog copy"):
                change()
        with pytest.raises(UsageError, match="this very store"):
            store.copy(f"{published}/")
    with hl.open(published, read_only=True) as store:
        assert store.topic("/arm").count() == 860
        proxy.requests.clear()
        forbidden: list[Callable[[], Any]] = [
            lambda: store.edit("run", note="x"),
            lambda: store.pin("run"),
            lambda: store.remove("run"),
        ]
        for change in forbidden:
            with pytest.raises(StoreError, match="opened for reading only"):
                change()
    assert not any(method != "GET" for method, _, _ in proxy.requests)
    assert answer("index", "arrays", "/scan", store=Path(published), code=5).out == ""
    with pytest.raises(StoreError, match="There is no store at"):
        hl.open(published + "/none")
    with pytest.raises(UsageError, match="without MongoDB"):
        hl.open(published, mongo="embedded")
    assert address_of(Path(published)) == published
    assert address_of("./s3") is None
