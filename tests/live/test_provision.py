"""Memory for what will come, and chunks as large as suits the rate."""

from __future__ import annotations

import errno
import mmap
import threading
import time
from contextlib import closing

import pytest

import hybridlog as hl
from hybridlog.live import provision as module
from hybridlog.live.provision import Provision
from hybridlog_storage import buffers as pool_module
from hybridlog_storage.buffers import SLAB, Buffers
from hybridlog_storage.copying import COPIED_AT_ONCE
from hybridlog_storage.messages import Channel
from hybridlog_storage.segment_writer import SegmentSettings
from tests.live.test_recording import channel, text
from tests.test_faults import wait_for

SIZE = 1 << 18
BUDGET = 128 * SIZE
MUCH = 2 * SIZE * module._CHUNKS  # bytes a second for which chunks are twice as large, at least


@pytest.fixture
def pool(monkeypatch: pytest.MonkeyPatch) -> Buffers:
    own = Buffers()
    monkeypatch.setattr(module, "buffers", own)
    return own


def comes(provision: Provision, rate: float, looks: int = 2) -> None:
    """So much comes, by default for as long as it takes to believe it."""
    for _ in range(looks):
        provision.look(rate)
        wait_for(lambda: provision._thread is None or not provision._thread.is_alive())


def test_an_eighth_of_the_budget_is_there_before_the_first_message(pool: Buffers) -> None:
    with closing(Provision(SIZE, BUDGET)) as provision:
        assert pool._given == {SLAB: BUDGET // 8}
        comes(provision, 0)
        comes(provision, BUDGET / 8)
        assert provision._thread is None


@pytest.mark.usefixtures("pool")
def test_nothing_is_done_while_it_is_not_known_how_much_will_come() -> None:
    with closing(Provision(SIZE, BUDGET)) as provision:
        for rate in [1e6, 1e8, 1e9, 2e9]:
            provision.look(rate)
        assert provision._thread is None
        comes(provision, 2e9)
        assert provision.chunk_size == 4 * SIZE


def test_as_much_as_comes_while_a_disk_stands_still_but_no_more_than_half_the_budget(
    pool: Buffers,
) -> None:
    rate = 0.5 * BUDGET
    with closing(Provision(SIZE, BUDGET)) as provision:
        comes(provision, rate)
        assert pool._given == {SLAB: rate * module._AHEAD_S}
        comes(provision, 100 * BUDGET)
        assert pool._given == {SLAB: BUDGET // 2}
        comes(provision, 1000 * BUDGET, looks=10)
        assert pool._given == {SLAB: BUDGET // 2}
    assert pool._whole_bytes <= pool_module._SPARE_BYTES


@pytest.mark.parametrize(
    ("rate", "times"), [(MUCH / 2, 1), (MUCH / 2 + 1, 2), (MUCH, 2), (MUCH + 1, 4), (1e12, 4)]
)
@pytest.mark.usefixtures("pool")
def test_chunks_are_larger_where_they_would_be_too_many(rate: float, times: int) -> None:
    with closing(Provision(SIZE, BUDGET)) as provision:
        comes(provision, rate)
        assert provision.chunk_size == times * SIZE


@pytest.mark.usefixtures("pool")
def test_what_comes_by_fits_and_starts_is_provided_for() -> None:
    with closing(Provision(SIZE, BUDGET)) as provision:
        for rate in [1e12, 0]:
            comes(provision, rate, looks=1)
        assert provision.chunk_size == 4 * SIZE


def test_a_disk_that_stands_still_changes_nothing(pool: Buffers) -> None:
    """Nothing comes then, for as long as the budget is spent."""
    with closing(Provision(SIZE, BUDGET)) as provision:
        comes(provision, 1e12, looks=3)
        given, thread = dict(pool._given), provision._thread
        comes(provision, 0, looks=10 * module._LOOKS)
        comes(provision, 1e12)
        assert provision._thread is thread
        assert pool._given == given


@pytest.mark.usefixtures("pool")
def test_chunks_become_small_again_when_little_comes_for_long() -> None:
    with closing(Provision(SIZE, BUDGET)) as provision:
        comes(provision, 2 * MUCH)
        comes(provision, MUCH / 2 - 1, looks=module._LOOKS - 1)
        assert provision.chunk_size == 4 * SIZE
        comes(provision, MUCH / 2 - 1)
        assert provision.chunk_size == SIZE
        comes(provision, MUCH)
        assert provision.chunk_size == 2 * SIZE
        comes(provision, MUCH / 4 + 1, looks=2 * module._LOOKS)
        assert provision.chunk_size == 2 * SIZE


@pytest.mark.usefixtures("pool")
def test_no_chunk_takes_much_of_the_budget() -> None:
    with closing(Provision(SIZE, 2 * module._SHARE * SIZE - 1)) as provision:
        comes(provision, 1e12)
        assert provision.chunk_size == SIZE
    with closing(Provision(SIZE, SIZE)) as provision:
        comes(provision, 1e12)
        assert provision.chunk_size == SIZE


@pytest.mark.usefixtures("pool")
def test_no_chunk_becomes_larger_than_a_slab(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is at hand could not serve for it."""
    monkeypatch.setattr(module, "_AHEAD_S", 0)
    with closing(Provision(SLAB // 2, 1 << 40)) as provision:
        comes(provision, 1e12)
        assert provision.chunk_size == SLAB
    with closing(Provision(2 * SLAB, 1 << 30)) as provision:
        comes(provision, 1e12)
        assert provision.chunk_size == 2 * SLAB


def test_where_there_is_no_memory_it_is_asked_for_once(
    pool: Buffers, monkeypatch: pytest.MonkeyPatch
) -> None:
    with closing(Provision(SIZE, BUDGET)) as provision:
        asked = []

        def refuse(size: int) -> mmap.mmap:
            asked.append(size)
            raise OSError(errno.ENOMEM, "no memory")

        monkeypatch.setattr(pool_module, "new_memory", refuse)
        comes(provision, 1e12, looks=10)
        assert asked == [SLAB]
        assert pool.take(SIZE).size == SIZE
        # What is there does for large chunks as well.
        assert provision.next_chunk_size() == 4 * SIZE


def test_who_closes_does_not_wait_for_all_of_it(
    pool: Buffers, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_PAUSE", 1e9)
    with closing(Provision(SIZE, 16 * SLAB)) as provision:
        given = pool._given[SLAB]
        provision.look(1e12)
        provision.look(1e12)
        wait_for(lambda: provision._thread is not None)
    assert provision._thread is not None
    assert not provision._thread.is_alive()
    assert given <= pool._given[SLAB] <= given + SLAB


def test_what_waits_leaves_memory_to_chunks_and_large_chunks_leave_some_to_messages(
    pool: Buffers,
) -> None:
    with closing(Provision(SIZE, 4 * BUDGET)) as provision:
        comes(provision, 1e12)
        there = pool._given[SLAB] // SIZE
        held = [pool.take(SIZE) for _ in range(int(there * (1 - module._FOR_CHUNKS)))]
        assert provision.has_room(0)
        held.append(pool.take(SIZE))
        assert not provision.has_room(0)
        while len(held) < there * (1 - module._FOR_SMALL):
            assert provision.next_chunk_size() == 4 * SIZE
            held.append(pool.take(SIZE))
        assert provision.next_chunk_size() == 4 * SIZE
        held.append(pool.take(SIZE))
        assert provision.next_chunk_size() == SIZE
        held.clear()
        assert provision.has_room(0)
        assert provision.next_chunk_size() == 4 * SIZE


def test_no_large_chunk_asks_for_memory(pool: Buffers) -> None:
    """Much may be spare, but nowhere enough at one place."""
    with closing(Provision(SIZE, BUDGET)) as provision:
        comes(provision, 1e12)
        held = [pool.take(SIZE) for _ in range(pool._given[SLAB] // SIZE)]
        del held[1::2]
        assert provision.next_chunk_size() == SIZE
        assert not provision.has_room(0)
        del held[:]
        assert provision.next_chunk_size() == 4 * SIZE


def test_usual_chunks_need_nothing(pool: Buffers) -> None:
    with closing(Provision(SIZE, BUDGET)) as provision:
        held = [pool.take(SIZE) for _ in range(pool._given[SLAB] // SIZE)]
        assert not provision.has_room(0)
        assert provision.next_chunk_size() == SIZE
        assert held


def test_a_recording_of_much_has_larger_chunks(
    store: hl.Store, pool: Buffers, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And what is in them is what was written, in order."""
    monkeypatch.setattr(module, "_CHUNKS", 4)
    own = [channel(f"/talk{n}") for n in range(3)]
    sizes = [10, 20_000, 150_000, 300_000, COPIED_AT_ONCE]
    written: dict[Channel, list[bytes]] = {one: [] for one in own}
    settings = SegmentSettings(chunk_size=SIZE)
    until = time.monotonic() + 30
    with store.start("talk", budget_bytes=1 << 28, settings=settings) as recording:
        provision = recording._provision

        def speak(one: Channel) -> None:
            n = 0
            while (provision.next_chunk_size() == SIZE and time.monotonic() < until) or n % 20:
                written[one].append(text(bytes([n % 251]) * sizes[n % len(sizes)]))
                recording.write(one, written[one][-1], log_time=n)
                n += 1
                time.sleep(0.02)

        threads = [threading.Thread(target=speak, args=(one,)) for one in own]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert provision.next_chunk_size() == 4 * SIZE
    for one in own:
        assert [m.raw for m in store.topic(one.topic)] == written[one]
    assert store.verify().findings == []
