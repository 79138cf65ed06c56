"""Windows over a store: every frame against the log, in every state of the store."""

from __future__ import annotations

import multiprocessing
import pickle
import shutil
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
import pytest

import hybridlog as hl
from hybridlog.training.windows import Windows
from hybridlog_storage.errors import PayloadError, SegmentError, StoreError, UsageError
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.training.test_lerobot import (
    ARM_STEP,
    FPS,
    GO,
    GO_STEP,
    MAP,
    MS,
    SECOND,
    SILENT,
    START,
    Log,
    arm,
    export,
    grey,
    rows_of,
)

LENGTH, HORIZON = 3, 5
FRAMES = LENGTH + HORIZON
FRONT = "observation.images.front"


def windows(store: hl.Store, **options: Any) -> Windows:
    given = {"fps": FPS, "length": LENGTH, "horizon": HORIZON, "features": MAP} | options
    return store.windows(["arm", "go", "cam"], **given)


def check(window: dict[str, Any], *, is_silent: bool = True) -> None:
    """Every value of a window is that of the log; those of the frames that are not stale."""
    assert window["observation.state"].shape == (FRAMES, 3)
    assert window[FRONT].shape[0] == LENGTH
    for frame in range(FRAMES):
        if window["is_stale"][frame]:
            continue
        time = int(window["log_time"][frame]) - START
        told = [np.float32(one) for one in arm(time // ARM_STEP * ARM_STEP)]
        assert window["observation.state"][frame].tolist() == told
        go = (time - 30 * MS) // GO_STEP * GO_STEP + 30 * MS
        if is_silent and go in SILENT:  # not long enough to be a gap yet
            go = SECOND - 20 * MS
        assert window["action"][frame].tolist() == [np.float32(go / MS)]
        if frame < LENGTH:
            assert {*np.unique(window[FRONT][frame])} == {grey(time)}


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with one recording with a gap, of small chunks."""
    path = tmp_path_factory.mktemp("windows") / "store"
    with hl.open(path, create=True, mongo="none") as store:
        Log(silent=SILENT).write(store, "one", settings=SMALL)
    return path


SMALL = SegmentSettings(chunk_size=64 << 10, compression="none")


def copied(plain: Path, path: Path) -> Path:
    """A copy of the store that may be changed."""
    return Path(shutil.copytree(plain, path / "store"))


def test_windows_are_those_of_the_log_and_of_the_export(plain: Path, tmp_path: Path) -> None:
    with hl.open(plain, mongo="none") as store:
        found = windows(store)
        assert found.names["observation.state"] == ("arm.q[0]", "arm.q[1]", "arm.load")
        for window in found:
            assert not window["is_stale"].any()
            check(window)
        # Nine windows less than frames in each of two episodes; 15 frames are in the gap.
        assert len(found) == 25 + 40 - 2 * (FRAMES - 1)
        assert found.left_out == (15, 0)
        assert found.remarks() == ["15 frames left out, because a topic has a gap there."]
        none = windows(store, episodes_by="mark")
        assert (len(none), none.remarks()[0][:19]) == (0, "There is no episode")
        assert (found[-1]["log_time"] == found[len(found) - 1]["log_time"]).all()
        assert [one["episode"] for one in found[17:19]] == [0, 1]
        with pytest.raises(IndexError):
            found[len(found)]
        export(store, tmp_path / "set", on_gap="drop")
        states = [row["observation.state"] for row in rows_of(tmp_path / "set")]
        assert states[:FRAMES] == found[0]["observation.state"].tolist()
        # A chunk is read once for the pictures next to each other.
        found = pickle.loads(pickle.dumps(found))
        assert found[0][FRONT].flags.writeable
        assert found.counters.chunks_read <= LENGTH
        assert len(windows(store, length=30).episodes) == 1
        assert windows(store, length=30).left_out == (15, 25)


def test_the_order_of_a_seed_is_always_the_same(plain: Path) -> None:
    with hl.open(plain, mongo="none") as store:
        found = windows(store)
        assert found.order(7)[:6].tolist() == [38, 33, 10, 18, 17, 30]
        assert sorted(found.order(8)) == [*range(len(found))]


def test_a_gap_is_refused_or_held(plain: Path) -> None:
    with hl.open(plain, mongo="none") as store:
        with pytest.raises(UsageError, match=r"one: /go has a gap of 1\.05s"):
            windows(store, on_gap="refuse")
        found = windows(store, on_gap="hold")
        stale = np.array([window["is_stale"] for window in found])
        assert stale[:, 0].sum() == 15
        for window in found:
            check(window)
        assert found.remarks()[0].startswith("15 frames may have values that are older")


def test_a_picture_that_cannot_be_shown_is_told(tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        Log(broken=10).write(store, "one")
        found = windows(store)
        check(found[0], is_silent=False)
        with pytest.raises(PayloadError, match=r"the picture of /cam at .*:21Z cannot be shown"):
            found[18]
        stale = 0
        for window in windows(store, on_gap="hold"):
            stale += int(window["is_stale"][0])
            check(window, is_silent=False)
        assert stale == 2
        with pytest.raises(PayloadError, match="no picture of /cam can be shown"):
            windows(store, on_gap="hold", length=2)[20]


@pytest.mark.parametrize("how", ["columns", "alone"])
def test_payloads_in_columns_are_read(plain: Path, tmp_path: Path, how: str) -> None:
    with hl.open(copied(plain, tmp_path), mongo="none") as store:
        made_before = windows(store)
        store.compact(["one"], ["cam"], drop_mcap=how == "alone")
        for found in (made_before, windows(store)):
            for place in (0, 20, -1):
                check(found[place])


def test_expired_payloads_are_refused_or_told(plain: Path, tmp_path: Path) -> None:
    with hl.open(copied(plain, tmp_path), mongo="none") as store:
        store.keep({"topic": {"/cam": "0s"}})
        with pytest.raises(PayloadError, match="cannot be shown, or has no payload"):
            windows(store)[0]
        with pytest.raises(PayloadError, match="no picture of /cam"):
            windows(store, on_gap="hold")[0]
        numbers = {"features": MAP["features"]}
        assert windows(store, features=numbers)[0]["action"].shape == (FRAMES, 1)


def test_damage_is_told_window_by_window(plain: Path, tmp_path: Path) -> None:
    """A picture in a damaged chunk is refused; what the log has lost already is stale."""
    path = copied(plain, tmp_path)
    (segment,) = path.glob("recordings/one/*.mcap")
    with hl.open(path, mongo="none") as store:
        made_before = windows(store)
        flip(segment)
    with (
        hl.open(path, mongo="none") as damaged,
        hl.open(tmp_path / "new", create=True, mongo="none") as store,
    ):
        store.record(segment)
        lost = windows(store)
        assert any("lost in 1 place" in one for one in lost.remarks())
        for found in (pickle.loads(pickle.dumps(made_before)), windows(damaged), lost):
            check_damaged(found)


def flip(path: Path) -> None:
    """Change a byte in the middle."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)


def check_damaged(found: Windows) -> None:
    """Some windows are right, the others are refused or say which frames are stale."""
    is_whole = told = 0
    for place in range(len(found)):
        try:
            window = found[place]
        except (SegmentError, StoreError):
            told += 1
            continue
        check(window)
        told += bool(window["is_stale"].any())
        is_whole += not window["is_stale"].any()
    assert told
    assert is_whole > 20


def test_what_does_not_fit_is_refused(plain: Path) -> None:
    with hl.open(plain, mongo="none") as store:
        own = {"features": {"features": {"is_stale": {"arm": "load"}}}}
        for wrong in ({"length": 0}, {"horizon": -1}, {"fps": 0}, own):
            with pytest.raises(UsageError):
                windows(store, **wrong)
        assert len(windows(store, length=100)) == 0
        for topics in ("cam", store.topic("cam")):  # the map is proposed by the type
            found = store.windows(topics, fps=10, length=1)
            assert found[0]["observation.images.cam"].shape[0] == 1


def test_a_running_recording_is_refused(tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        Log().write(store, "one")
        with store.start("now", flush_interval_s=0.05) as recording:
            recording.write(GO, b'{"x": 1}', log_time=START + 60 * SECOND)
            deadline = monotonic() + 60
            while store.topic("go").count() < 81:
                assert monotonic() < deadline
            with pytest.raises(UsageError, match="now is being recorded, so its windows would"):
                windows(store)
            assert len(store.windows(store.recordings("one").topic("cam"), fps=10, length=1))


def load(found: Windows, places: list[int], answers: Any) -> None:
    """A worker of a data loader."""
    answers.put({place: found[place] for place in places})


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.parametrize("way", ["fork", "spawn"])
def test_workers_of_a_data_loader_read_windows(plain: Path, way: str) -> None:
    with hl.open(plain, mongo="none") as store:
        found = windows(store)
        wanted = {place: found[place] for place in found.order(3)[:8].tolist()}
        context = multiprocessing.get_context(way)
        answers = context.Queue()
        parts = [[*wanted][:4], [*wanted][4:]]
        workers = [context.Process(target=load, args=(found, part, answers)) for part in parts]
        for worker in workers:
            worker.start()
        told = answers.get(timeout=60) | answers.get(timeout=60)
        for worker in workers:
            worker.join(60)
            assert worker.exitcode == 0
        for place, window in wanted.items():
            for name, value in window.items():
                np.testing.assert_array_equal(told[place][name], value)
