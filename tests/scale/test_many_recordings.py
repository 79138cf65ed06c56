"""What a question costs depends on what it is about, not on what else the store holds."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog_storage.messages import Channel
from tests.copies import bring
from tests.independent import write_mcap
from tests.many_topics import FLOAT
from tests.scale.cost import Cost, cost_of

pytestmark = pytest.mark.mongo("embedded")

DAY = 86_400 * 10**9
START = 18_262 * DAY  # 2020-01-01
FEW, MANY = 10, 50
MESSAGES = 12


def write_day(path: Path, day: int) -> None:
    """A log of one day: a few messages of two topics."""
    channels = [(Channel("/pose", "ros1", FLOAT), 0), (Channel("/imu", "ros1", FLOAT), 100 * day)]
    said = [
        (channel, START + day * DAY + number * 10**9, struct.pack("<f", more + number))
        for number in range(MESSAGES)
        for channel, more in channels
    ]
    write_mcap(path, said)


def fill(path: Path, count: int) -> None:
    log = path.parent / "day.mcap"
    with hl.open(path, create=True):
        pass
    with hl.open(path, mongo="none") as store:
        for day in range(count):
            write_day(log, day)
            store.record(log, name=f"day{day:05d}")
    with hl.open(path, require_database=True):  # indexes all
        pass


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """A store of few recordings, and one of many."""
    top = tmp_path_factory.mktemp("scale")
    # Names of one length, since manifests hold paths.
    paths = {count: top / f"{count:05d}" / "store" for count in (FEW, MANY)}
    for count, path in paths.items():
        path.parent.mkdir()
        fill(path, count)
    return paths


def day(number: int) -> tuple[int, int]:
    return START + number * DAY, START + (number + 1) * DAY


Work = Callable[[hl.Store], object]
ASKED: dict[str, Work] = {
    "at": lambda store: store.topic("pose").at(day(3)[1]),
    "fetch of a day": lambda store: list(store.topic("pose").between(*day(4))),
    "frame of a day": lambda store: store.topic("pose").between(*day(4)).to_pandas(),
    "count of a day": lambda store: store.topic("pose").between(*day(4)).count(),
    "count with a predicate": lambda store: (
        store.topic("pose").where("data > 4.5").between(*day(4)).count()
    ),
    "filter of MongoDB": lambda store: (
        store.topic("pose").where({"data": {"$gt": 4.5}}).between(*day(4)).count()
    ),
    "intervals of a day": lambda store: (
        store.topic("pose").where("data > 4.5").between(*day(4)).intervals()
    ),
    "sync of a day": lambda store: [
        *store.sync([store.topic(name).between(*day(4)) for name in ("pose", "imu")], clock="log")
    ],
    "align of a day": lambda store: store.align(
        store.topic("pose").between(*day(4)), ["imu"]
    ).to_arrow(),
    "first of all": lambda store: [*store.topic("pose").limit(1)],
    "last of all": lambda store: [*store.topic("pose").reverse().limit(1)],
    "one recording": lambda store: store.query(["/pose"], ["day00004"]).count(),
    "topics": lambda store: store.topics(),
    "chosen ones": lambda store: [
        *store.recordings("day0*", has="pose", type="Float32", during=day(4))
    ],
    "chosen by content": lambda store: [
        *store.recordings(during=(day(3)[0], day(4)[1]), where="pose: data > 4.5")
    ],
    "info of one": lambda store: store.entry("day00004"),
}
"""Questions about little."""


@pytest.mark.parametrize("name", ASKED)
def test_questions_about_little_cost_little(stores: dict[int, Path], name: str) -> None:
    costs = {}
    asks_mongodb = name == "filter of MongoDB"
    for count, path in stores.items():
        with hl.open(path, mongo=None if asks_mongodb else "none") as store:
            ASKED[name](store)
            store.refresh()
            if asks_mongodb:
                store.shared.index.connect()
            costs[count] = cost_of(store, lambda store=store: ASKED[name](store))
    assert costs[MANY].counts == costs[FEW].counts
    # What is compressed has another size on another day. The file of tables that the recording
    # shares with others is read as far as it is needed, in blocks that columns share.
    shared = sum(path.stat().st_size for path in stores[MANY].glob("tables/*/shared-*"))
    assert costs[MANY].bytes_read < 1.1 * costs[FEW].bytes_read + 2 * shared


def test_opening_asks_once(stores: dict[int, Path]) -> None:
    """The catalog is read once, and MongoDB is asked for its mark and its size only."""
    time.sleep(0.2)  # what was written within a tick of the clock is read again
    counts = {}
    for count, path in stores.items():
        with hl.open(path, require_database=True) as store:
            store.refresh()
            counts[count] = cost_of(store, store.shared.index.connect).counts
    assert counts[MANY] == counts[FEW]
    assert counts[MANY]["opened"] < 30


CHANGES: dict[str, Work] = {
    "tag": lambda store: store.edit("day00004", tag={"place": "hall"}),
    "note": lambda store: store.edit("day00004", note="all quiet"),
    "rename": lambda store: store.edit("day00004", name="fourth"),
    "rename back": lambda store: store.edit("fourth", name="day00004"),
    "verify of one": lambda store: store.verify(["day00004"]),
    "reindex of one": lambda store: store.index.rebuild(["day00004"]),
    "repair of one": lambda store: store.verify(["day00004"], repair=True),
}


def check_alike(costs: dict[int, Cost], *, looks: bool = True) -> None:
    """Check that work costs as much with many recordings as with few."""
    few, many = costs[FEW].counts, costs[MANY].counts
    # A shared file is written once or twice, and the index reads a segment in one pass or two.
    assert abs(many.pop("opened") - few.pop("opened")) < 40
    assert many == few
    assert not looks or abs(costs[MANY].looks - costs[FEW].looks) < 20


LOOKS_AT_ALL = {"rename", "rename back", "verify of one", "reindex of one", "repair of one"}
"""They compare all recordings with their files, or the names of all, first."""


@pytest.mark.parametrize("name", CHANGES)
def test_work_on_one_recording_costs_the_same(stores: dict[int, Path], name: str) -> None:
    costs = {}
    for count, path in stores.items():
        with hl.open(path, mongo="none" if name != "reindex of one" else None) as store:
            if name == "reindex of one":
                store.shared.index.connect()
            store.verify(["day00003"])  # what Python loads is loaded
            costs[count] = cost_of(store, lambda store=store: CHANGES[name](store))
    check_alike(costs, looks=name not in LOOKS_AT_ALL)


def test_a_recording_is_imported_without_a_look_at_the_others(
    stores: dict[int, Path], tmp_path: Path
) -> None:
    for name, number in (("before", 5_000), ("more", 5_001)):
        write_day(tmp_path / f"{name}.mcap", number)
        with hl.open(tmp_path / f"from-{name}", create=True, mongo="none") as store:
            store.record(tmp_path / f"{name}.mcap")
    imports, answers, removals = {}, {}, {}
    for count, path in stores.items():
        with hl.open(path, mongo="none") as store:
            bring(store, tmp_path / "from-before")
            asked = store.topic("pose").where("data > 4.5").between(*day(5_001))
            imports[count] = cost_of(
                store, lambda store=store: bring(store, tmp_path / "from-more")
            )
            answers[count] = cost_of(store, lambda asked=asked: asked.count())
            assert asked.count() == MESSAGES - 5
            removals[count] = cost_of(store, lambda store=store: store.remove("more"))
            store.remove("before")
            assert store.topic("pose").count() == count * MESSAGES
    check_alike(imports, looks=False)  # a copy opens the store that it goes to
    for costs in (answers, removals):
        check_alike(costs)


def test_a_recording_is_indexed_without_a_look_at_the_others(
    stores: dict[int, Path], tmp_path: Path
) -> None:
    write_day(tmp_path / "more.mcap", 5_001)
    costs = {}
    for count, path in stores.items():
        with hl.open(path, mongo="none") as store:
            store.record(tmp_path / "more.mcap")
        with hl.open(path) as store:
            costs[count] = cost_of(store, store.shared.index.connect)
            assert store.shared.repairs.indexed == {"more": 1}
            store.remove("more")
        with hl.open(path) as store:
            assert not cost_of(store, store.shared.index.connect).written
    assert costs[MANY].commands == costs[FEW].commands
    # A few files, and each folder that was made just now: not the files of each recording.
    assert len(costs[MANY].opened) < len(costs[FEW].opened) + 2 * MANY


def test_sql_of_a_day_opens_tables_of_that_day(stores: dict[int, Path]) -> None:
    with hl.open(stores[MANY], mongo="none") as store:
        asked = f"select count(*) from pose where t >= {day(4)[0]} and t < {day(4)[1]}"
        cost = cost_of(store, lambda: store.sql(asked).rows())
        assert store.sql(asked).rows() == [(MESSAGES,)]
        assert len([path for path in cost.opened if path.startswith("part-")]) < 50
        named = "select count(*) from pose where recording = 'day00007'"
        assert store.sql(named).rows() == [(MESSAGES,)]


def test_a_shared_table_decides_a_predicate(stores: dict[int, Path]) -> None:
    """No recording is read, and once they are known, none of their manifests."""
    last = 100 * (MANY - 1)
    wanted = {
        f"data > {last + 4.5}": MESSAGES - 5,
        "data in [1205, 1150, -1]": 1,
        "data > 100 and data < 108.5": 8,
        "not (data < 1e9)": 0,
        "data != 5": MANY * MESSAGES - 1,
        f"data < 0 or data > {last + 100}": 0,
        "data == 1204.5": 0,
        "data in [1204.5, -3]": 0,
    }
    for _ in range(2):
        with hl.open(stores[MANY], mongo="none") as store:
            imu = store.topic("imu")
            assert imu.where("data == 1205").count() == 1
            for text, count in wanted.items():
                assert imu.where(text).count() == count
                assert sum(1 for _ in imu.where(text)) == count
    with hl.open(stores[MANY], mongo="none") as store:
        imu = store.topic("imu")
        costs = [cost_of(store, imu.where(text).count) for text in wanted]
        assert not [one for cost in costs for one in cost.opened if one.endswith(".mcap")]
        for cost in costs[1:]:
            assert {*cost.opened} <= {str(store.directory.path)}
        store.edit("day00012", tag={"place": "hall"})
        assert imu.where("data in [1205, 3]").count() == 2


def test_one_more_recording_costs_the_same(stores: dict[int, Path], tmp_path: Path) -> None:
    """It is recorded, and removed again."""
    counts, removals = {}, {}
    write_day(tmp_path / "more.mcap", 5_000)
    write_day(tmp_path / "before.mcap", 5_001)
    for count, path in stores.items():
        with hl.open(path, require_database=True) as store:
            store.record(tmp_path / "before.mcap")
            counts[count] = cost_of(store, lambda store=store: store.record(tmp_path / "more.mcap"))
            store.remove("before")
            store.shared.index.connect()
            removals[count] = cost_of(store, lambda store=store: store.remove("more"))
            assert store.topic("pose").count() == count * MESSAGES
    check_alike(counts, looks=False)  # no other has its name or its content
    check_alike(removals)
