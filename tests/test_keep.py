"""`hybridlog keep`: passes of retention and pins, on stores of many small segments."""

from __future__ import annotations

import errno
import random
import re
import shutil
import struct
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import hybridlog as hl
from hybridlog.cli.commands.open import unplayed
from hybridlog.entries import summary_of
from hybridlog.maintenance import keep as keeping
from hybridlog.maintenance.edit import pin_of
from hybridlog.maintenance.keep import Keeper
from hybridlog.maintenance.retention import Rules, may_go
from hybridlog.maintenance.sizes import disk_bytes
from hybridlog_storage.disk import files
from hybridlog_storage.disk.directory import StoreDirectory
from hybridlog_storage.errors import (
    DiskFullError,
    HybridlogError,
    PayloadError,
    StoreError,
    TimeError,
)
from hybridlog_storage.manifest import File, new_id, replace
from hybridlog_storage.manifests import DiskManifests
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.calls import Calls
from tests.cli.running import run
from tests.cli.within import answer
from tests.damage import flip
from tests.power import PowerCut

CAMERA = Channel("/camera", "ros1", Schema("a/Image", "ros1msg", b"uint32 n\nuint8[] data\n"), {})
ARM = Channel("/arm", "ros1", Schema("a/Arm", "ros1msg", b"uint32 n\nfloat64 x\n"), {})
SECOND = 10**9
BEGIN = 1_700_000_000 * SECOND
COUNT = 120


def image(number: int) -> bytes:
    data = random.Random(number).randbytes(4000)
    return struct.pack("<II", number, len(data)) + data


def record(store: hl.Store) -> None:
    settings = SegmentSettings(chunk_size=1024, segment_size=50_000)
    with store.start("run", settings=settings) as recording:
        for number in range(COUNT):
            at = BEGIN + number * SECOND
            recording.write(CAMERA, image(number), log_time=at)
            recording.write(ARM, struct.pack("<Id", number, number / 2), log_time=at + 1)


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with a recording of many segments: a message of each topic a second, two minutes."""
    path = tmp_path_factory.mktemp("keep") / "store"
    with hl.open(path, mongo="none", create=True) as store:
        record(store)
        store.mark("run", "+100s", "slipped", {"trigger": "bump"})
    return path


@pytest.fixture
def store(recorded: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded, tmp_path / "store", copy_function=shutil.copy2))


keep = partial(answer, "keep")


def logs_of(store: Path) -> dict[int, File]:
    manifest = places.read_in(places.folder(store, "run"))
    assert manifest is not None
    return manifest.logs


def pin(at: str, around: str, path: Path) -> None:
    """Pin the camera around a time."""
    words = ("-r", "run", "-t", "camera", "--at", at, "--before", around, "--after", around)
    keep("--pin", *words, store=path)


def payloads(path: Path) -> dict[int, bytes | None]:
    """Payloads of the camera by number; None for those that have expired."""
    found: dict[int, bytes | None] = {}
    with hl.open(path, mongo="none") as opened:
        for message in opened.topic("/camera"):
            try:
                found[message.fields["n"]] = message.raw
            except PayloadError:
                found[message.fields["n"]] = None
    return found


def check_answers(path: Path) -> None:
    """Counts and fields are those of all messages, whatever has expired."""
    with hl.open(path, mongo="none") as opened:
        assert opened.topic("/camera").count() == opened.topic("/arm").count() == COUNT
        assert opened.topic("/arm").where("x >= 30").count() == COUNT - 60
        assert opened.topic("/camera").between("+10s", "+20s").count() == 10
        assert [m.fields["n"] for m in opened.topic("/arm")] == [*range(COUNT)]
        assert opened.recordings()[0].status == "complete"
        assert opened.verify().findings == []


def test_a_pass_makes_room_and_leaves_counts_fields_and_pins(store: Path) -> None:
    used, before = disk_bytes(store), logs_of(store)
    pin("+10s", "2s", store)
    quota = used * 4 // 5
    (dry, done) = (
        keep("--quota", quota, "--json", *words, store=store).json for words in (["--dry-run"], [])
    )
    assert dry["dry_run"]
    assert dry["freed_bytes"] == 0
    (first, *_) = done["plan"]["steps"]
    assert first == dry["plan"]["steps"][0]
    assert first["recording"] == "run"
    assert f"more than 90% of {quota / 1000:.1f} kB" in first["reason"]
    gone = sorted(n for step in done["plan"]["steps"] for n in step["segments"])
    # The oldest went, but for those with what is pinned.
    manifest = places.read_in(places.folder(store, "run"))
    assert manifest is not None
    free = [
        number
        for number, log in before.items()
        if may_go(log)
        and all(
            part.last < BEGIN + 8 * SECOND or part.first > BEGIN + 12 * SECOND
            for channel, part in log.parts.items()
            if manifest.channels[channel].topic == "/camera"
        )
    ]
    assert len(free) > 5
    assert gone == free[: len(gone)]
    left = payloads(store)
    assert all(raw is None or raw == image(n) for n, raw in left.items())
    assert all(left[n] is not None for n in (*range(8, 13), *range(100, COUNT)))
    assert done["freed_bytes"] > 0.1 * used
    assert disk_bytes(store) < 0.9 * quota
    check_answers(store)
    # What went does not go again.
    again = keep("--quota", quota, "--json", store=store).json
    assert again["plan"]["steps"] == []


def test_topics_go_and_the_rest_of_their_segments_stays(store: Path) -> None:
    out = keep("--topic", "/camera=0s", store=store).out
    assert re.search(r"(?m)^run +1, 3, .*, 21 +[0-9.]+ kB  ", out)
    assert "/camera older than 0s" in out
    assert {*payloads(store).values()} == {None}
    with hl.open(store, mongo="none") as opened:
        assert [m.raw for m in opened.topic("/arm")] == [
            struct.pack("<Id", n, n / 2) for n in range(COUNT)
        ]
    check_answers(store)
    assert "0 B freed" in keep("--topic", "/camera=0s", store=store).out
    with hl.open(store, mongo="none") as opened:
        told = "Messages without their payload are not played; there are some of /camera."
        assert unplayed(opened.all_topics()) == [told]


def test_a_recording_goes_with_its_fields(store: Path) -> None:
    assert keep("--fields-age", "1y", "--json", store=store).json["plan"]["steps"] == []
    keep("--pin", "-r", "run", store=store)
    assert keep("--fields-age", "0s", "--json", store=store).json["plan"]["steps"] == []
    (row,) = keep("--pins", "--json", store=store).json
    keep("--unpin", row["id"], store=store)
    assert re.search(r"(?m)^run +all  ", keep("--fields-age", "0s", store=store).out)
    with hl.open(store, mongo="none") as opened:
        assert opened.session.look().summaries == []


def test_saved_rules_are_those_of_later_passes(store: Path) -> None:
    answer("tag", "run", "keep=yes", store=store)
    rules = ("--quota", "1GB", "--topic", "/camera=0s", "--never-tag", "keep=yes")
    keep(*rules, "--save", store=store)
    assert StoreDirectory(store).settings.retention == {
        "quota": "1GB",
        "topic": {"/camera": "0s"},
        "never-tag": ["keep=yes"],
    }
    found = keep("--json", store=store).json["plan"]
    assert found["steps"] == []
    answer("tag", "run", "--remove", "keep", store=store)
    assert keep("--json", store=store).json["plan"]["steps"]


def test_too_little_may_go(store: Path) -> None:
    keep("--pin", "-r", "run", store=store)
    found = run("keep", "--quota", "1kB", "--mongo", "none", store=store, code=1)
    assert re.search(r"A quota of 1.0 kB cannot be kept.*: [56]\d\d\.\d kB must stay", found.err)
    assert payloads(store)[0] == image(0)


@pytest.mark.parametrize("words", [("--max-age", "0s"), ("--quota", "80kB")])
def test_a_damaged_log_and_its_group_stay_and_the_others_go(
    store: Path, words: tuple[str, ...]
) -> None:
    path = places.segment(store, "run", 1)
    flip(path, 20_000)
    content = path.read_bytes()
    found = keep(*words, store=store, code=None)
    assert "000001.mcap" in found.err
    assert found.err.count("Its payloads stay until the file is restored from a copy") == 1
    assert path.read_bytes() == content
    logs = logs_of(store)
    assert [n for n, log in logs.items() if log.number != log.group and log.is_here] == [1]


def test_a_rule_that_fits_no_topic_is_told(store: Path) -> None:
    found = keep("--topic", "/camara=0s", "--topic", "camera=9y", "--dry-run", store=store)
    assert "No topic matches /camara" in found.err
    assert "camera=" not in found.err


def test_a_plan_promises_what_goes(store: Path) -> None:
    words = ("--max-age", "0s", "--json")
    plan = keep(*words, "--dry-run", store=store).json["plan"]
    (step,) = plan["steps"]
    done = keep(*words, store=store).json
    # What is left of a message takes some room.
    assert 0.8 < done["freed_bytes"] / step["bytes"] <= 1
    assert step["segments"] == [n for n, log in logs_of(store).items() if log.number != log.group]
    gone = sum(raw is None for raw in payloads(store).values())
    assert f"{gone} payloads deleted" in answer("ls", store=store).out
    assert answer("ls", "--json", store=store).json[0]["expired"] == gone
    with hl.open(store, mongo="none") as opened:
        told = str(opened.topic("camera").completeness())
    words = f"{gone} messages have no payload, which was deleted to make room"
    assert told == f"no message is lost; {words}"


def test_an_import_says_where_payloads_are(store: Path, recorded: Path, tmp_path: Path) -> None:
    whole = Path(shutil.copytree(recorded, tmp_path / "whole"))
    keep("--max-age", "0s", store=store)
    assert answer("copy", "--from", store, store=whole).out == "run is here already\n"
    assert payloads(whole)[0] == image(0)
    assert (
        "payloads that were deleted here were not copied"
        in answer("copy", "--from", whole, store=store).out
    )
    answer("copy", "--from", store, store=tmp_path / "copy")
    assert payloads(tmp_path / "copy") == payloads(store)


# Pins.


def pins(path: Path) -> list[tuple[float | None, float | None, Any]]:
    """Begin and end of each pin in seconds of the recording, and its topics."""
    rows = keep("--pins", "--json", store=path).json
    return [
        (*(None if r[k] is None else (r[k] - BEGIN) // SECOND for k in ("from", "to")), r["topics"])
        for r in rows
    ]


PINNED: tuple[tuple[str, tuple[float | None, float | None, Any]], ...] = (
    ("-r run", (None, None, None)),
    ("--tag robot=7", (None, None, None)),
    ("-r run --at +30s --before 10s --after 5s", (20, 35, None)),
    ("-r run --at +30s --topic camera", (30, 30, ["/camera"])),
    # A predicate: while it held. A message is valid until the next one.
    ("-r run --when arm:~x~>=~10~and~x~<~20", (20, 40, None)),
    ("-r * --when arm:~x~=~5 --before 3s", (7, 11, None)),
    # Marks, all or some, and what a trigger has marked.
    ("-r run --when /hybridlog/marks --after 2s", (100, 102, None)),
    ("-r run --when /hybridlog/marks:~text~=~'slipped'", (100, 100, None)),
    ("-r run --when /hybridlog/marks:~tags.trigger~=~'bump' --before 1m", (40, 100, None)),
)


def words_of(text: str) -> list[str]:
    return [word.replace("~", " ") for word in text.split()]


def test_what_is_pinned(store: Path) -> None:
    answer("tag", "run", "robot=7", store=store)
    for words, right in PINNED:
        out = keep("--pin", *words_of(words), "--reason", "why not", store=store).out
        assert pins(store) == [right], words
        name = out.removeprefix("1 pin: ").strip()
        keep("--unpin", name, store=store)
    assert pins(store) == []
    keep("--pin", "-r", "run", "--reason", "why not", store=store)
    (row,) = keep("--pins", "--json", store=store).json
    assert row["reason"] == "why not"
    assert row["id"] in keep("--pins", store=store).out
    assert answer("info", "run", "--json", store=store).json[0]["pins"][0]["id"] == row["id"]


REFUSED = (
    "",
    "--pin",
    "--pin --pins -r run",
    "--pin -r run --dry-run",
    "--pin -r run --at yesterday",
    "--pin -r run --at 2020-01-01",
    "--pin -r run --at +200s --before 80s",
    "--pin -r run --when arm:~x~>~1000",
    "--pin -r run --when nothing:~x~>~1",
    "--pin -r other",
    "--unpin nothing",
    "--at +1s --quota 1GB",
    "--quota 1GB -r run",
    "--topic /camera",
    "--save",
    "--never-tag a=b",
)


def test_usage_that_is_refused(store: Path) -> None:
    before = files_of(store)
    for words in REFUSED:
        keep(*words_of(words), store=store, code=2)
    assert files_of(store) == before


def files_of(path: Path) -> dict[str, bytes]:
    names = [p for p in places.root(path).rglob("*") if p.is_file() and p.name != "writer.lock"]
    return {str(p): p.read_bytes() for p in [*names, path / "hybridlog.toml"]}


def test_a_pin_outside_of_its_recording_is_refused(store: Path) -> None:
    with hl.open(store, mongo="none") as opened:
        after = BEGIN + COUNT * SECOND
        for begin, end in ((BEGIN - SECOND, BEGIN), (after, after + SECOND)):
            with pytest.raises(TimeError, match="has no message then"):
                opened.pin("run", begin, end)
        opened.pin("run", BEGIN + (COUNT - 1) * SECOND, None)


@pytest.mark.parametrize("what", ["pin", "tag"])
@pytest.mark.parametrize("when", ["expire", "write_rows", "remove"])
def test_what_is_said_meanwhile_keeps_what_is_not_gone(
    store: Path, monkeypatch: pytest.MonkeyPatch, when: str, what: str
) -> None:
    """Before the fields are written, when segments are to be replaced, and before the removal."""
    rule = "--fields-age" if when == "remove" else "--max-age"
    if when == "remove":
        keep("--max-age", "0s", store=store)
    before = payloads(store)
    said = {
        "tag": {"tags": {"stay": "yes"}},
        "pin": {"pins": (pin_of("now", (None, None), None, ""),)},
    }
    place: Any = {"expire": keeping, "write_rows": keeping, "remove": DiskManifests}[when]
    work = getattr(place, when)

    def said_before(*words: Any, **options: Any) -> Any:
        places.change_in(places.folder(store, "run"), lambda now: replace(now, **said[what]))
        return work(*words, **options)

    monkeypatch.setattr(place, when, said_before)
    found = keep(rule, "0s", "--never-tag", "stay", store=store)
    assert "was set meanwhile" in found.err
    assert places.names(store) == ["run"]
    assert payloads(store) == before
    check_answers(store)


def test_what_may_have_lost_pins_is_left_alone(store: Path) -> None:
    places.manifest_of(places.folder(store, "run")).unlink()
    answer("verify", "--repair", "--mongo", "none", store=store, code=None)
    keep("--max-age", "0s", "--fields-age", "0s", store=store)
    assert all(raw == image(n) for n, raw in payloads(store).items())


def test_one_process_at_a_time(store: Path) -> None:
    with StoreDirectory(store).retaining(), hl.open(store, mongo="none") as opened:
        with pytest.raises(StoreError, match="already"):
            opened.keep({"max-age": "0s"})
    assert payloads(store)[0] == image(0)


def test_whole_groups_go_when_no_payloads_are_left(store: Path) -> None:
    """Every answer is of what is left, and nothing else is found to be wrong."""
    keep("--pin", "-r", "run", "--at", "+60s", "--before", "9s", "--after", "9s", store=store)
    found = keep("--quota", "200kB", "--json", store=store, code=None).json
    (step,) = [step for step in found["plan"]["steps"] if step["groups"]]
    assert "no payloads are left to go" in step["reason"]
    assert not {log.group for log in logs_of(store).values()} & {*step["groups"]}
    with hl.open(store, mongo="none") as opened:
        arms, cameras = ([m.fields["n"] for m in opened.topic(t)] for t in ("/arm", "/camera"))
        assert {*range(51, 70)} <= {*arms} & {*cameras}
        assert max(len(arms), len(cameras)) < COUNT
        (entry,) = opened.recordings()
        assert entry.messages == len(arms) + len(cameras) + len(entry.manifest.marks)
        for topic, numbers in (("/arm", arms), ("/camera", cameras)):
            query = opened.topic(topic)
            assert query.count() == query.where("n >= 0").count() == len(numbers)
            assert query.to_arrow().num_rows == len(numbers)
            assert opened.sql(f"select n from {topic[1:]} order by n").rows() == [
                (number,) for number in numbers
            ]
        assert opened.verify().findings == []
    answer("verify", "--repair", "--mongo", "none", store=store, code=None)
    with hl.open(store, mongo="none") as opened:
        assert opened.topic("/arm").count() == len(arms)
        (known,) = opened.session.look().summaries
        assert known == summary_of(opened.entry(known.id), known.look)


# A full disk.


class Full(files.System):
    """Nothing can be written as long as the spare file is there."""

    def __init__(self, store: Path) -> None:
        self.spare = store / keeping.SPARE

    def writev(self, fd: int, parts: Sequence[memoryview]) -> int:
        if self.spare.exists():
            raise OSError(errno.ENOSPC, "full")
        return super().writev(fd, parts)


@pytest.mark.parametrize("has_rules", [True, False])
def test_a_full_disk_is_relieved_and_fields_stay(
    tmp_path: Path, calls: Calls, *, has_rules: bool
) -> None:
    """With rules the rows are there already; without, they get the room of the spare file."""
    path = tmp_path / "store"
    with hl.open(path, mongo="none", create=True) as store:
        if has_rules:
            store.directory.change_settings(retention={"quota": "1GB"})
        record(store)
        store.keep({"quota": "1GB"})

        def full(*_: object, **__: object) -> None:
            assert not has_rules
            if (path / keeping.SPARE).exists():
                raise DiskFullError

        calls(keeping, "write_rows", full)
        if has_rules:
            calls.system(Full(path))
        (step,) = store.keep({"max-age": "0s"}).plan.steps
    assert not (path / keeping.SPARE).exists()
    assert {*payloads(path).values()} == {None}
    assert step.segments == tuple(n for n, log in logs_of(path).items() if not log.is_here)
    check_answers(path)
    assert not hl.open(path, mongo="none").recordings()[0].losses


def test_a_log_that_goes_without_its_fields_is_counted(store: Path, calls: Calls) -> None:
    calls.fail(keeping, "write_rows", DiskFullError)
    keep("--topic", "/camera=0s", store=store)
    with hl.open(store, mongo="none") as opened:
        (entry,) = opened.recordings()
        camera = opened.topic("/camera")
        lost = COUNT - camera.count()
        assert lost > 50
        assert {(one["cause"], one["reason"]) for one in entry.losses} == {
            ("segment", "deleted without its fields: the disk was full")
        }
        assert sum(one["count"] for one in entry.losses) == lost
        assert len([m.raw for m in camera]) == camera.where("n >= 0").count() == COUNT - lost
        assert f"{lost} messages" in str(camera.completeness())
        assert [m.fields["n"] for m in opened.topic("/arm")] == [*range(COUNT)]
        assert opened.verify().findings == []


# What a crash leaves.


def cut_pass(path: Path, calls: int | None, monkeypatch: pytest.MonkeyPatch) -> PowerCut:
    """Make a pass that lets go all but what is pinned; the power fails at a call."""
    power = PowerCut(path, calls)
    with monkeypatch.context() as patch:
        patch.setattr(files, "system", power)
        opened = None
        with suppress(HybridlogError, OSError):
            opened = hl.open(path, mongo="none")
            opened.keep({"topic": {"/camera": "0s"}})
            opened.keep({"max-age": "0s"})
        if opened is not None:
            with suppress(HybridlogError, OSError):
                opened.close()
    return power


CUTS = [
    *(n / 3 for n in range(3)),
    *(pytest.param(n / 100, marks=pytest.mark.exhaustive) for n in range(100)),
]


@pytest.fixture(scope="module")
def pinned(tmp_path_factory: pytest.TempPathFactory, recorded: Path) -> tuple[Path, int]:
    """A store with a pin, and the calls of the system that a pass makes."""
    base = tmp_path_factory.mktemp("pinned")
    store = Path(shutil.copytree(recorded, base / "store", copy_function=shutil.copy2))
    pin("+50s", "9s", store)
    whole = Path(shutil.copytree(store, base / "whole", copy_function=shutil.copy2))
    with pytest.MonkeyPatch.context() as patch:
        return store, cut_pass(whole, None, patch).calls


@pytest.mark.parametrize("share", CUTS)
def test_a_cut_costs_no_pinned_byte_and_no_count(
    tmp_path: Path,
    pinned: tuple[Path, int],
    share: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    kept, calls = pinned
    assert calls > 100
    store = Path(shutil.copytree(kept, tmp_path / "store", copy_function=shutil.copy2))
    power = cut_pass(store, 1 + round(share * calls), monkeypatch)
    for fate in range(2):
        found = tmp_path / f"found{fate}"
        power.after_cut(found, random.Random(f"{share}{fate}"))
        for _ in range(2):  # as it was left, and after another pass
            left = payloads(found)
            assert all(left[n] == image(n) for n in range(41, 60))
            assert all(raw is None or raw == image(n) for n, raw in left.items())
            with hl.open(found, mongo="none") as opened:
                opened.shared.recover()
            check_answers(found)
            keep("--max-age", "0s", store=found)
        assert left[0] is None


# What a pass costs.


def test_a_plan_opens_each_manifest_once(recorded: Path, tmp_path: Path, calls: Calls) -> None:
    with hl.open(tmp_path / "many", mongo="none", create=True) as store:
        directory = store.directory
    manifest = places.read_in(places.folder(recorded, "run"))
    assert manifest is not None
    for _ in range(200):
        one = replace(manifest, id=new_id("run"))
        folder = directory.recording(one.id)
        folder.mkdir()
        places.write_in(folder, one)
    keeper = Keeper(directory, lambda *_: None)
    rules = Rules.of({"max-age": "0s"})
    opened = calls(files.system, "open")
    assert len(keeper.plan(rules).steps) == 200
    assert [name for name, *_ in opened] == [f"{one}.json" for one in directory.ids()]
