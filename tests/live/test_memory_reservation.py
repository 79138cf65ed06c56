"""Memory is reserved ahead, and chunks follow the incoming rate."""

from __future__ import annotations

import errno
import threading
import time
from contextlib import closing

import pytest

import hybridlog as hl
from hybridlog.live import memory as module
from hybridlog.live.memory import MemoryReservation
from hybridlog_storage import buffers as pool_module
from hybridlog_storage.buffers import SLAB, Buffers
from hybridlog_storage.disk.copying import COPIED_AT_ONCE
from hybridlog_storage.messages import Channel
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.calls import Calls
from tests.limits import Limit
from tests.live.test_recording import channel, text
from tests.waiting import wait_for

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


@pytest.mark.usefixtures("pool")
def test_nothing_is_done_while_it_is_not_known_how_much_will_come() -> None:
    with closing(MemoryReservation(SIZE, BUDGET)) as reservation:
        for rate in [1e6, 1e8, 1e9, 2e9]:
            reservation.observe(rate)
        assert reservation._thread is None
        comes(reservation, 2e9)
        assert reservation.chunk_size == 4 * SIZE


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


@pytest.mark.parametrize(
    ("rate", "times"), [(MUCH / 2, 1), (MUCH / 2 + 1, 2), (MUCH, 2), (MUCH + 1, 4), (1e12, 4)]
)
@pytest.mark.usefixtures("pool")
def test_chunks_are_larger_where_they_would_be_too_many(rate: float, times: int) -> None:
    with closing(MemoryReservation(SIZE, BUDGET)) as reservation:
        comes(reservation, rate)
        assert reservation.chunk_size == times * SIZE


@pytest.mark.usefixtures("pool")
def test_what_comes_by_fits_and_starts_is_provided_for() -> None:
    with closing(MemoryReservation(SIZE, BUDGET)) as reservation:
        for rate in [1e12, 0]:
            comes(reservation, rate, looks=1)
        assert reservation.chunk_size == 4 * SIZE


def test_a_disk_that_stands_still_changes_nothing(pool: Buffers) -> None:
    """Nothing comes then, for as long as the budget is spent."""
    with closing(MemoryReservation(SIZE, BUDGET)) as reservation:
        comes(reservation, 1e12, looks=3)
        given, thread = dict(pool._given), reservation._thread
        comes(reservation, 0, looks=10 * module._RATES)
        comes(reservation, 1e12)
        assert reservation._thread is thread
        assert pool._given == given


@pytest.mark.usefixtures("pool")
def test_chunks_become_small_again_when_little_comes_for_long() -> None:
    with closing(MemoryReservation(SIZE, BUDGET)) as reservation:
        comes(reservation, 2 * MUCH)
        comes(reservation, MUCH / 2 - 1, looks=module._RATES - 1)
        assert reservation.chunk_size == 4 * SIZE
        comes(reservation, MUCH / 2 - 1)
        assert reservation.chunk_size == SIZE
        comes(reservation, MUCH)
        assert reservation.chunk_size == 2 * SIZE
        comes(reservation, MUCH / 4 + 1, looks=2 * module._RATES)
        assert reservation.chunk_size == 2 * SIZE


@pytest.mark.usefixtures("pool")
def test_no_chunk_takes_much_of_the_budget() -> None:
    with closing(MemoryReservation(SIZE, 2 * module._SHARE * SIZE - 1)) as reservation:
        comes(reservation, 1e12)
        assert reservation.chunk_size == SIZE
    with closing(MemoryReservation(SIZE, SIZE)) as reservation:
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


def test_who_closes_does_not_wait_for_all_of_it(pool: Buffers, limit: Limit) -> None:
    limit(buffer_pause_ratio=1e9)
    with closing(MemoryReservation(SIZE, 16 * SLAB)) as reservation:
        given = pool._given[SLAB]
        reservation.observe(1e12)
        reservation.observe(1e12)
        wait_for(lambda: reservation._thread is not None)
    assert reservation._thread is not None
    assert not reservation._thread.is_alive()
    assert given <= pool._given[SLAB] <= given + SLAB


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


def test_no_large_chunk_asks_for_memory(pool: Buffers) -> None:
    """Much may be spare, but nowhere enough at one place."""
    with closing(MemoryReservation(SIZE, BUDGET)) as reservation:
        comes(reservation, 1e12)
        held = [pool.take(SIZE) for _ in range(pool._given[SLAB] // SIZE)]
        del held[1::2]
        assert reservation.next_chunk_size() == SIZE
        del held[:]
        assert reservation.next_chunk_size() == 4 * SIZE


def test_usual_chunks_need_nothing(pool: Buffers) -> None:
    with closing(MemoryReservation(SIZE, BUDGET)) as reservation:
        held = [pool.take(SIZE) for _ in range(pool._given[SLAB] // SIZE)]
        assert reservation.next_chunk_size() == SIZE
        assert held


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

        threads = [threading.Thread(target=speak, args=(one,)) for one in own]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert reservation.next_chunk_size() == 4 * SIZE
    for one in own:
        assert [m.raw for m in store.topic(one.topic)] == written[one]
    assert store.verify().findings == []
