"""A store in a bucket answers as the one on the disk, with few requests, or with an error."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import hybridlog as hl
from hybridlog.maintenance.bucket_place import BucketPlace
from hybridlog.maintenance.keep import tidy
from hybridlog_storage.disk import files
from hybridlog_storage.errors import (
    HybridlogError,
    ObjectExistsError,
    ResourceError,
    StoreError,
    UsageError,
)
from hybridlog_storage.remote import address_of
from hybridlog_storage.remote.blocks import BLOCK, BlockCache
from hybridlog_storage.remote.bucket import Bucket
from hybridlog_storage.remote.lists import MANIFEST, StoreList, list_name
from hybridlog_storage.remote.store import RemoteDirectory
from tests.cli import running as commands
from tests.cli.within import Answer, answer
from tests.copies import bring
from tests.limits import Limit
from tests.remote.conftest import BEGIN, RECORDINGS, SECOND, publish_all
from tests.remote.server import Proxy


def everything(store: hl.Store) -> dict[str, Any]:
    """Answers of all kinds."""
    return {
        "recordings": [
            (one.id, one.name, one.status, one.tags, one.notes, one.marks, one.span, one.messages)
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
        return len([one for one in proxy.requests if "list-type" not in one[1]])

    with hl.open(published) as store:
        assert len(proxy.requests) <= 3
        assert asked(store.recordings) == 0
        assert asked(lambda: store.catalog.table(store.entry("run"), 0)) <= 2
        second = store.topic("/scan").between(BEGIN + 20 * SECOND, BEGIN + 21 * SECOND)
        assert asked(lambda: list(second)) <= 3
        assert asked(lambda: list(second)) == 0
        holding = store.topic("/arm").where("x > 5 and x < 50")
        assert asked(holding.count) <= 4 + 2 * len(RECORDINGS)
        assert asked(holding.count) == 0
    files.mounted.clear()  # another process has the cache, too
    proxy.requests.clear()
    with hl.open(published) as store:
        assert len(proxy.requests) <= 2
        assert asked(store.topic("/arm").where("x > 5 and x < 50").count) == 0


def test_edits(here: Path, address: str, proxy: Proxy) -> None:
    publish_all(here, address, ("run", "short-0"))
    with hl.open(address) as store:
        store.edit("run", tag={"who": "me"})
        store.edit("run", note="good")
        assert store.edit("run", name="A new run").name == "A new run"
        store.remove("short-0")
        assert [one.name for one in store.recordings()] == ["A new run"]
    files.mounted.clear()
    with hl.open(address) as store:
        (entry,) = store.recordings()
        assert (entry.name, entry.tags) == ("A new run", {"place": "lab", "who": "me"})
        assert [note["text"] for note in entry.notes] == ["good"]
        assert store.topic("/arm").count() == 400
        assert not store.verify().findings
    answer("tag", "A new run", "why=test", store=Path(address))
    assert "why=test" in answer("ls", store=Path(address)).out


def test_a_change_is_one_manifest_and_one_list(here: Path, address: str, proxy: Proxy) -> None:
    """The manifest before it is listed no more; readers of an older list still have it."""
    publish_all(here, address, ("run",))
    with hl.open(address) as store:
        directory = store.directory
        assert isinstance(directory, RemoteDirectory)
        recording = store.entry("run").id
        old = directory.files_of(recording)[MANIFEST]
        proxy.requests.clear()
        store.edit("run", tag={"x": "1"})
        made = [path for method, path, _ in proxy.requests if method == "PUT"]
        assert ["/lists/" in path for path in made] == [False, True]
        new = directory.files_of(recording)[MANIFEST]
        assert new.name in made[0]
        assert {one.name for one in Bucket(address).objects("recordings")} > {old.name, new.name}
        with pytest.raises(UsageError, match="has no tag"):
            store.edit("run", untag=["y"])
    files.mounted.clear()
    with hl.open(address) as store:
        assert store.entry("run").tags["x"] == "1"


def test_the_command_copies(here: Path, address: str, proxy: Proxy) -> None:
    said = answer("copy", "-r", "short-*", address, "--json", store=here).json
    assert (said["copied"], said["known"]) == (["short-0", "short-1", "short-2"], [])
    proxy.requests.clear()
    said = answer("copy", "-r", "short-*", address, "--json", store=here).json
    assert (said["copied"], said["known"]) == ([], ["short-0", "short-1", "short-2"])
    assert len(proxy.requests) <= 3 + 3
    with hl.open(address) as store:
        assert store.topic("/arm").count() == 60


def test_two_who_change_at_once(here: Path, address: str, proxy: Proxy) -> None:
    publish_all(here, address, ("run", "short-0"))
    one = hl.open(address)
    is_first = True

    def other(*words: str) -> None:
        command = [sys.executable, "-m", "hybridlog", *words, "--store", address]
        subprocess.run(command, check=True, capture_output=True)

    def meanwhile(_: int) -> str:
        nonlocal is_first
        method, name, _ = proxy.requests[-1]
        if method == "PUT" and "/lists/" in name and is_first:
            is_first = False
            other("tag", "run", "b=2")
        return ""

    proxy.spoil = meanwhile
    one.edit("run", tag={"a": "1"})
    assert not is_first
    proxy.reset()
    proxy.old_lists = {}
    assert one.entry("run").tags == {"place": "lab", "a": "1", "b": "2"}
    other("tag", "short-0", "c=3")
    one.edit("short-0", tag={"d": "4"})  # the list that it sees is from before
    proxy.reset()
    files.mounted.clear()
    with hl.open(address) as last:
        assert last.entry("run").tags == {"place": "lab", "a": "1", "b": "2"}
        assert last.entry("short-0").tags == {"c": "3", "d": "4"}


def test_marks_pins_and_rules(here: Path, address: str, proxy: Proxy) -> None:
    """Objects are added, and those that are not listed any more can be tidied away."""
    publish_all(here, address, ("run", "more"))
    with hl.open(address) as store:
        directory = store.directory
        assert isinstance(directory, RemoteDirectory)
        ids = [store.entry(name).id for name in ("run", "more")]
        whole = {one: {*directory.files_of(one).values()} for one in ids}
        raw = [message.raw for message in store.topic("/scan").in_recording("run")]
        kept = store.mark("run", "+2s", "seen", {"by": "lab"}, until="+3s").marks
        assert [mark["text"] for mark in kept] == ["slipped", "seen"]
        store.mark("run", "+4s", "wrong")
        assert len(store.unmark("run", "wrong").marks) == 2
        pin = store.pin("run", "+0s", "+5s", reason="to keep")
        assert store.unpin(store.pin("more")) is None
        rule = ("keep", "--min-free", "1GB", "--save")
        answer(*rule, store=Path(address), code=2)
        assert not directory.settings.retention
        with pytest.raises(UsageError, match="use --quota"):
            store.keep({"min-free": "1GB"})
        said = answer("keep", "--quota", "1MB", "--save", "--json", store=Path(address), code=None)
        print(said.err)
        assert said.json["freed_bytes"] > 500_000
        assert store.keep({"quota": "1MB"}).freed_bytes == 0
    files.mounted.clear()
    with hl.open(address) as store:
        directory = store.directory
        assert isinstance(directory, RemoteDirectory)
        assert directory.settings.retention == {"quota": "1MB"}
        (entry,) = store.recordings("run")
        assert ([one["id"] for one in entry.pins], entry.marks) == ([pin], kept)
        assert not store.verify().findings
        for label, topic in (("run", "/scan"), ("more", "/scan"), ("run", "/arm")):
            assert store.topic(topic).in_recording(label).count() == 400
        found = [*store.topic("/scan").in_recording("run")]
        states = [message.state for message in found]
        pinned = [
            number for number, one in enumerate(found) if one.log_time_ns < BEGIN + 5 * SECOND
        ]
        assert {states[number] for number in pinned} == {"whole"}
        assert {"expired", "whole"} == {*states}
        assert [found[number].raw for number in pinned] == [raw[number] for number in pinned]
        assert store.topic("/arm").in_recording("run").where("x >= 100").count() == 200
        gone = set().union(*whole.values()) - {
            one for label in whole for one in directory.files_of(label).values()
        }
        now = directory.source.bucket.now()
        names = {one.name for one in directory.unneeded(now + 8 * 24 * 3600 * SECOND)}
        assert gone
        assert {one.name for one in gone} <= names
        directory.source.bucket.delete([*names])
        assert not store.verify().findings
        assert [m.raw for m in store.topic("/scan").in_recording("run").limit(10)] == raw[:10]


def test_tidying_leaves_what_may_be_needed(here: Path, address: str, proxy: Proxy) -> None:
    publish_all(here, address, ("run", "short-0"))
    hour, week = 3600 * SECOND, 7 * 24 * 3600 * SECOND
    with hl.open(address) as store:
        directory = store.directory
        assert isinstance(directory, RemoteDirectory)
        gone, run = store.entry("short-0").id, store.entry("run").id
        store.remove("short-0")
        store.edit("run", tag={"a": "b"})
        directory.source.bucket.create("recordings/x/000000.mcap", b"of a copy")
        now = directory.source.bucket.now()
        assert tidy(store.directory) == (0, 0)
        later = [one.name for one in directory.unneeded(now + 2 * hour)]
        assert later == [list_name(number) for number in (3, 2, 1)]
        names = {one.name for one in directory.unneeded(now + week + hour)}
        assert {name for name in names if gone not in name} == {
            *later,
            "recordings/x/000000.mcap",
            f"recordings/{run}/manifest.json",
        }
        assert len(names) > 6
        directory.source.bucket.delete([*names])
        assert directory.unneeded(now + week + hour) == []
        assert not store.verify().findings
        assert store.topic("/arm").count() == 400
    said = answer("keep", "--tidy", "--dry-run", "--json", store=Path(address))
    assert said.json == {"objects": 0, "bytes": 0, "dry_run": True}


def test_old_objects_are_not_taken_for_own(address: str, proxy: Proxy, limit: Limit) -> None:
    bucket = Bucket(address)
    bucket.create("a", b"1")
    bucket.create("a", b"1")
    limit(bucket_unlisted_days=1)
    with pytest.raises(ObjectExistsError):
        bucket.create("a", b"1")


def test_two_who_send_large_files_at_once(
    here: Path,
    address: str,
    proxy: Proxy,
    monkeypatch: pytest.MonkeyPatch,
    limit: Limit,
    tmp_path: Path,
) -> None:
    """Some servers give a new version to the same bytes when they come again."""
    limit(bucket_whole_bytes=10_000, bucket_part_bytes=5_000)
    publish = BucketPlace.publish

    def overtaken(place: BucketPlace, data: bytes) -> str:
        monkeypatch.setattr(BucketPlace, "publish", publish)
        with hl.open(here, mongo="none") as other:
            assert other.copy(address, ["short-0"]).copied == ["short-0"]
        bucket = place._target.source.bucket
        for path, one in place._there.items():
            content = bucket.read(one.name, [(0, one.size)])[0]
            version = bucket._put(one.name, content, "overwrite")
            assert version != one.version
            place._there[path] = replace(one, version=version)
        return publish(place, data)

    monkeypatch.setattr(BucketPlace, "publish", overtaken)
    with hl.open(here, mongo="none") as store:
        assert store.copy(address, ["short-0"]).copied == ["short-0"]
    files.mounted.clear()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "elsewhere"))
    with hl.open(address) as store:
        assert len(list(store.topic("/arm"))) == 20
        assert len(store.recordings()) == 1


def test_damaged_fields_are_left_out(
    here: Path, address: str, proxy: Proxy, tmp_path: Path
) -> None:
    source = Path(shutil.copytree(here, tmp_path / "source"))
    shared = [*source.glob("tables/*/shared-*.parquet")]
    for path in shared:
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        path.write_bytes(data)
    publish_all(source, address, ("short-0", "short-1"))
    with hl.open(address) as store:
        assert store.topic("/arm").where("x >= 5").count() == 20
    assert shared


def lose(address: str, ending: str, recording: str = "", *, changes: bool = False) -> str:
    """Delete the last object whose name ends like this, or change it; its name."""
    bucket = Bucket(address)
    *_, name = (
        one.name
        for one in bucket.objects()
        if one.name.endswith(ending) and recording in one.name and "lists/" not in one.name
    )
    data = bucket.read_whole(name, 1 << 30)[1]
    bucket.delete([name])
    if changes:
        bucket.create(name, data[:-1] + b"x")
    return name


@pytest.mark.parametrize("changes", [False, True])
def test_lost_objects(here: Path, address: str, tmp_path: Path, changes: bool) -> None:
    publish_all(here, address, ("run", "short-0"))
    with hl.open(here, mongo="none") as source:
        run = source.entry("run").id
        whole = source.entry("run").messages // 2
    with hl.open(address) as store:
        assert store.topic("/scan").count() == whole + 20
        lose(address, "000001.mcap", run, changes=changes)
        with pytest.raises(StoreError, match="missing or was changed"):
            list(store.topic("/scan"))  # it has begun to answer
        assert 20 < sum(1 for _ in store.topic("/scan")) < whole + 20
        assert store.topic("/scan").completeness().has_losses
    files.mounted.clear()
    with hl.open(address) as store:
        left = sum(1 for _ in store.topic("/scan")) - 20
        assert 0 < left < whole
        (row,) = store.sql("select count(x) as n from arm").to_arrow().to_pylist()
        assert row["n"] == store.topic("/arm").count() < whole + 20
        question = store.topic("/scan")
        assert question.count() == left + 20
        assert question.completeness().has_losses
        found = store.verify()
        assert [(one.recording, one.place) for one in found.findings] == [("run", "000001.mcap")]
        assert "hybridlog copy" in found.findings[0].cure
        assert found.recordings == 2
    with hl.open(tmp_path / "back", mongo="none", create=True) as store:
        report = bring(store, address)
        assert (report.copied, [*report.refused]) == (["short-0"], ["run"])
        assert f"--store {address} run" in report.refused["run"]
    with hl.open(here, mongo="none") as source:
        assert source.copy(address, ["run", "short-0"]).copied == ["run"]
        assert source.copy(address, ["run", "short-0"]).known == ["run", "short-0"]
    files.mounted.clear()
    with hl.open(address) as store:
        assert store.topic("/scan").count() == whole + 20
        assert not store.verify().findings


def test_lost_fields_and_manifests(here: Path, address: str, proxy: Proxy) -> None:
    publish_all(here, address, ("run", "short-0"))
    table = lose(address, ".parquet")
    files.mounted.clear()
    with hl.open(address) as store:
        assert store.topic("/arm").where("n < 10").count() == 20
        assert [one.place for one in store.verify().findings] == [table]
    lose(address, "/manifest.json", table.split("/")[-1].rpartition("-")[0])
    files.mounted.clear()
    with hl.open(address) as store:
        findings = store.verify().findings
        assert [one.place for one in findings] == ["manifest", table]
        assert "hybridlog copy" in findings[0].cure
        label = findings[0].recording
    files.mounted.clear()
    with hl.open(address) as store, pytest.raises(StoreError, match="has no manifest"):
        store.topic("/arm").where("n < 10").count()
    with hl.open(here, mongo="none") as source:
        proxy.requests.clear()
        assert source.copy(address, ["run", "short-0"]).copied == [label]
        assert not [one for one in proxy.requests if one[0] == "PUT" and ".mcap" in one[1]]
    files.mounted.clear()
    with hl.open(address) as store:
        assert not store.verify().findings


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
    roles = "Error performing PUT http://169.254.169.254/latest/api/token"
    assert "Set AWS_ACCESS_KEY_ID" in Bucket(address)._problem("lists", roles)
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    assert "http://127.0.0.1:9 does not answer" in told(lambda: hl.open(address))
    monkeypatch.delenv("AWS_ALLOW_HTTP")
    assert "Set AWS_ALLOW_HTTP=true" in told(lambda: hl.open(address))


def test_hostile_lists(published: str, proxy: Proxy) -> None:
    bucket = Bucket(published)
    newest = bucket.first("lists")
    assert newest is not None
    data = bucket.read_whole(newest.name, 1 << 30)[1]
    line, _, rest = zlib.decompress(data).partition(b"\n")
    head = json.loads(line)
    store, number = head["store"], len(RECORDINGS)
    assert newest.name == list_name(number)
    assert StoreList.from_bytes(store, number, data, "it").to_bytes() == data
    (recording, one), *_ = head["recordings"].items()
    (path, row), *_ = one.items()

    def refused(changed: dict[str, Any] | None, packed: bytes | None = None) -> None:
        text = json.dumps(changed).encode() + b"\n" + rest
        with pytest.raises(StoreError, match=r"it is (damaged|of a newer)"):
            StoreList.from_bytes(store, number, packed or zlib.compress(text), "it")

    refused({**head, "store": "other"})
    refused({**head, "format": 2})
    for wrong in ("../run", ".hidden", "a/b", "", "x" * 200, "run"):
        refused({**head, "recordings": {wrong: one}})
    for wrong in ("../../etc/passwd", "/etc/passwd", "a//b", "a/b/c/d"):
        refused({**head, "recordings": {recording: {**one, wrong: row}}})
    for bad in (["other/file", *row[1:]], [row[0] + "/../x", *row[1:]], [row[0], -1, ""], [1, 2]):
        refused({**head, "recordings": {recording: {**one, path: bad}}})
    refused(None, data[:-3])
    refused(None, zlib.compress(b"[]\n"))


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
    flipped = bytearray(data.read_bytes())
    flipped[5] ^= 1
    data.write_bytes(flipped)
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
        ]
        for change in refused:
            with pytest.raises(StoreError, match=r"is a store in a bucket.*hybridlog copy"):
                change()
    assert answer("index", "arrays", "/scan", store=Path(published), code=5).out == ""
    with pytest.raises(StoreError, match="There is no store at"):
        hl.open(published + "/none")
    with pytest.raises(UsageError, match="without MongoDB"):
        hl.open(published, mongo="embedded")
    assert address_of(Path(published)) == published
    assert address_of("./s3") is None


def test_all_commands_tell_of_lost_objects(here: Path, address: str) -> None:
    """In words and in JSON; of a recording that is left out by its bounds, too."""
    publish_all(here, address, ("run", "short-0"))
    with hl.open(here, mongo="none") as source:
        run = source.entry("run").id

    def told(*words: str) -> Answer:
        files.mounted.clear()
        return answer(*words, store=Path(address))

    lose(address, "000001.mcap", run)
    files.mounted.clear()
    assert hl.open(address).topic("arm").completeness().has_losses
    assert "stored data lost" in told("ls").out
    assert told("ls", "--json").json[0]["status"] != "complete"
    for count in ("n < 10", "n > 10000"):
        assert "20 lost" in told("fetch", "arm", "--where", count, "--count").err
    assert [one["place"] for one in told("verify", "--json").json["findings"]] == ["000001.mcap"]
    assert "run: 000001.mcap: " in commands.run("verify", store=Path(address), code=1).out
    lose(address, "/manifest.json", run)
    for _ in range(2):  # also if nothing else is left of it
        assert "has no manifest" in told("ls").err
        places = {one["place"] for one in told("verify", "--json").json["findings"]}
        assert {"000001.mcap", "manifest"} <= places
        for count in ("n < 10", "n > 10000"):
            found = commands.run(
                *("fetch", "arm", "--where", count, "--count"), store=Path(address), code=5
            )
            assert "has no manifest" in found.err
        files.mounted.clear()
        with pytest.raises(StoreError, match="has no manifest"):
            hl.open(address).topic("arm").where("n < 10").count()
        for name in ("000000.mcap", "000002.mcap"):
            if "000000.mcap" not in places:
                lose(address, name, run)
    with hl.open(here, mongo="none") as source:
        assert source.copy(address, ["run", "short-0"]).copied == ["run"]
    assert not told("verify", "--json").json["findings"]
    assert told("ls", "--json").json[0]["status"] == "complete"
