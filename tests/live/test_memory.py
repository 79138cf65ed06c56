"""Memory: reserved ahead, in chunks that follow the rate; its budget; what is not collected."""

from __future__ import annotations

import errno
import gc
import os
import time
import weakref
from collections.abc import Iterator
from contextlib import closing
from functools import partial
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog.live import memory as module
from hybridlog.live.memory import FrozenObjects, MemoryReservation
from hybridlog.live.recorder import RecorderOptions
from hybridlog.live.recording import LiveOptions
from hybridlog_storage import buffers as pool_module
from hybridlog_storage.buffers import SLAB, Buffers
from hybridlog_storage.disk.copying import COPIED_AT_ONCE
from hybridlog_storage.messages import Channel
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.calls import Calls
from tests.limits import Limit
from tests.live.test_recording import channel, text
from tests.waiting import at_once, wait_for

SIZE = 1 << 18
BUDGET = 128 * SIZE
MUCH = 2 * SIZE * module._MAX_CHUNKS_PER_S  # bytes a second that double the chunk size


@pytest.fixture
def pool(monkeypatch: pytest.MonkeyPatch) -> Buffers:
    own = Buffers()
    monkeypatch.setattr(module, "buffers", own)
    return own


def comes(reservation: MemoryReservation, rate: float, looks: int = 2) -> None:
    """Observe a rate, by default as often as it takes to act on it."""
    for _ in range(looks):
        reservation.observe(rate)
        wait_for(lambda: reservation._thread is None or not reservation._thread.is_alive())


def test_an_eighth_of_the_budget_is_there_before_the_first_message(pool: Buffers) -> None:
    with closing(MemoryReservation(SIZE, BUDGET)) as reservation:
        assert pool._given == {SLAB: BUDGET // 8}
        comes(reservation, 0)
        comes(reservation, BUDGET / 8)
        assert reservation._thread is None


def test_as_much_as_comes_while_a_disk_stands_still_but_no_more_than_half_the_budget(
    pool: Buffers,
) -> None:
    rate = 0.5 * BUDGET
    with closing(MemoryReservation(SIZE, BUDGET)) as reservation:
        comes(reservation, rate)
        assert pool._given == {SLAB: rate * module._AHEAD_S}
        comes(reservation, 100 * BUDGET)
        assert pool._given == {SLAB: BUDGET // 2}
        comes(reservation, 1000 * BUDGET, looks=10)
        assert pool._given == {SLAB: BUDGET // 2}
    assert pool._whole_bytes <= pool_module._MAX_IDLE_BYTES


FEW, LONG = MUCH / 2 - 1, module._RATES


@pytest.mark.parametrize(
    ("came", "times"),
    [
        ([(MUCH / 2, 2)], 1),
        ([(MUCH / 2 + 1, 2)], 2),
        ([(MUCH, 2)], 2),
        ([(MUCH + 1, 2)], 4),
        ([(1e12, 2)], 4),
        ([(1e6, 1), (1e8, 1), (1e9, 1), (2e9, 1)], 1),  # it is not known how much will come
        ([(1e12, 1), (0, 1)], 4),  # by fits and starts
        ([(2 * MUCH, 2), (FEW, LONG - 1)], 4),
        ([(2 * MUCH, 2), (FEW, LONG + 1)], 1),  # little for long
        ([(2 * MUCH, 2), (FEW, LONG + 1), (MUCH, 2)], 2),
        ([(2 * MUCH, 2), (FEW, LONG + 1), (MUCH, 2), (MUCH / 4 + 1, 2 * LONG)], 2),
    ],
)
@pytest.mark.usefixtures("pool")
def test_chunks_are_as_large_as_what_comes_asks_for(
    came: list[tuple[float, int]], times: int
) -> None:
    with closing(MemoryReservation(SIZE, BUDGET)) as reservation:
        for rate, looks in came:
            comes(reservation, rate, looks)
        assert reservation.chunk_size == times * SIZE


@pytest.mark.parametrize("budget", [2 * module._SHARE * SIZE - 1, SIZE])
@pytest.mark.usefixtures("pool")
def test_no_chunk_takes_much_of_the_budget(budget: int) -> None:
    with closing(MemoryReservation(SIZE, budget)) as reservation:
        comes(reservation, 1e12)
        assert reservation.chunk_size == SIZE


@pytest.mark.usefixtures("pool")
def test_no_chunk_becomes_larger_than_a_slab(limit: Limit) -> None:
    """What is at hand could not serve for it."""
    limit(ahead_s=0)
    with closing(MemoryReservation(SLAB // 2, 1 << 40)) as reservation:
        comes(reservation, 1e12)
        assert reservation.chunk_size == SLAB
    with closing(MemoryReservation(2 * SLAB, 1 << 30)) as reservation:
        comes(reservation, 1e12)
        assert reservation.chunk_size == 2 * SLAB


def test_where_there_is_no_memory_it_is_asked_for_once(pool: Buffers, calls: Calls) -> None:
    with closing(MemoryReservation(SIZE, BUDGET)) as reservation:
        calls.fail(pool_module, "new_memory", OSError(errno.ENOMEM, "no memory"))
        asked = calls(pool_module, "new_memory")
        comes(reservation, 1e12, looks=10)
        assert asked == [(SLAB,)]
        assert pool.take(SIZE).size == SIZE
        # What is there does for large chunks as well.
        assert reservation.next_chunk_size() == 4 * SIZE


def test_large_chunks_leave_some_memory_to_messages(
    pool: Buffers,
) -> None:
    with closing(MemoryReservation(SIZE, 4 * BUDGET)) as reservation:
        comes(reservation, 1e12)
        there = pool._given[SLAB] // SIZE
        held = []
        while len(held) < there * (1 - module._SHARE_FOR_SMALL):
            assert reservation.next_chunk_size() == 4 * SIZE
            held.append(pool.take(SIZE))
        assert reservation.next_chunk_size() == 4 * SIZE
        held.append(pool.take(SIZE))
        assert reservation.next_chunk_size() == SIZE
        held.clear()
        assert reservation.next_chunk_size() == 4 * SIZE


def test_a_recording_of_much_has_larger_chunks(
    store: hl.Store, pool: Buffers, limit: Limit
) -> None:
    """And what is in them is what was written, in order."""
    limit(max_chunks_per_s=4)
    own = [channel(f"/talk{n}") for n in range(3)]
    sizes = [10, 20_000, 150_000, 300_000, COPIED_AT_ONCE]
    written: dict[Channel, list[bytes]] = {one: [] for one in own}
    settings = SegmentSettings(chunk_size=SIZE)
    until = time.monotonic() + 30
    with store.start("talk", budget_bytes=1 << 28, settings=settings) as recording:
        reservation = recording._reservation

        def speak(one: Channel) -> None:
            n = 0
            while (reservation.next_chunk_size() == SIZE and time.monotonic() < until) or n % 20:
                written[one].append(text(bytes([n % 251]) * sizes[n % len(sizes)]))
                recording.write(one, written[one][-1], log_time=n)
                n += 1
                time.sleep(0.02)

        at_once(*(partial(speak, one) for one in own))
        assert reservation.next_chunk_size() == 4 * SIZE
    for one in own:
        assert [m.raw for m in store.topic(one.topic)] == written[one]
    assert store.verify().findings == []


MACHINE = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def groups(root: Path, name: str, limits: dict[str, str]) -> tuple[Path, Path]:
    """Control groups as Linux shows them, and what names one's own."""
    for group, limit in limits.items():
        (root / "groups" / group).mkdir(parents=True, exist_ok=True)
        (root / "groups" / group / "memory.max").write_text(limit)
    own = root / "own"
    own.write_text(f"12:cpu:/elsewhere\n0::{name}\n")
    return root / "groups", own


def test_a_limit_counts_wherever_it_is_set(tmp_path: Path) -> None:
    limits = {"a/b": "max\n", "a": f"{1 << 20}\n", "other": "7\n"}
    assert module.memory_bytes(*groups(tmp_path, "/a/b", limits)) == 1 << 20


def test_no_limit_is_the_machine(tmp_path: Path) -> None:
    assert module.memory_bytes(*groups(tmp_path, "/a", {"a": "max\n"})) == MACHINE
    assert module.memory_bytes(*groups(tmp_path, "/gone", {})) == MACHINE
    assert module.memory_bytes(*groups(tmp_path, "/../..", {})) == MACHINE
    assert module.memory_bytes(tmp_path / "none", tmp_path / "nowhere") == MACHINE


@pytest.mark.parametrize(
    ("memory", "want"),
    [(512 << 20, 64 << 20), (8 << 30, 512 << 20), (24 << 30, 1536 << 20), (1 << 40, 2 << 30)],
)
def test_a_sixteenth(monkeypatch: pytest.MonkeyPatch, memory: int, want: int) -> None:
    monkeypatch.setattr(module, "memory_bytes", lambda: memory)
    module.default_budget.cache_clear()
    try:
        assert module.default_budget() == want
        assert LiveOptions().budget_bytes == RecorderOptions().budget_bytes == want
    finally:
        monkeypatch.undo()
        module.default_budget.cache_clear()


@pytest.fixture
def frozen(monkeypatch: pytest.MonkeyPatch) -> Iterator[FrozenObjects]:
    """A context of this test alone, which other tests cannot hold open."""
    own = FrozenObjects()
    monkeypatch.setattr("hybridlog.live.recording.frozen_objects", own)
    gc.unfreeze()
    yield own
    assert gc.get_freeze_count() == 0


class Knot:
    """Refers to itself: only the collector can take it away."""

    def __init__(self) -> None:
        self.itself = self


def test_objects_are_frozen_until_the_last_has_left(frozen: FrozenObjects) -> None:
    knot = weakref.ref(Knot())
    with frozen:
        with frozen:
            assert gc.get_freeze_count() > 1000
        gc.collect()
        assert knot() is not None
        later = weakref.ref(Knot())
        gc.collect()
        assert later() is None
    gc.collect()
    assert knot() is None


def test_what_a_process_has_frozen_itself_stays_frozen(frozen: FrozenObjects) -> None:
    gc.freeze()
    try:
        with frozen:
            pass
        assert gc.get_freeze_count() > 1000
    finally:
        gc.unfreeze()


@pytest.mark.usefixtures("frozen")
def test_they_are_frozen_as_long_as_something_is_recorded(tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True) as store:
        with store.start("first"):
            with store.start("second"):
                pass
            assert gc.get_freeze_count() > 1000
        assert gc.get_freeze_count() == 0
        third = store.start("third")
        assert gc.get_freeze_count() > 1000
        third.abort()
