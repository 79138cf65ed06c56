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
from hybridlog_storage.buffers import Buffers
from hybridlog_storage.chunk_builder import COPIED_AT_ONCE
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
        assert pool._there[SIZE] == BUDGET // 8 // SIZE
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
        assert pool._there[SIZE] == rate * module._AHEAD_S // SIZE
        comes(provision, 100 * BUDGET)
        assert provision.chunk_size == 4 * SIZE
        # The others are given back only when all have heard that they are not taken any more.
        assert pool._there[SIZE] == rate * module._AHEAD_S // SIZE
        comes(provision, 100 * BUDGET, looks=1)
        assert pool._there == {SIZE: 0, 4 * SIZE: BUDGET // 2 // (4 * SIZE)}
    assert pool._spare_bytes <= pool_module._SPARE_BYTES


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
        there, thread = dict(pool._there), provision._thread
        comes(provision, 0, looks=10 * module._LOOKS)
        comes(provision, 1e12)
        assert provision._thread is thread
        assert pool._there == there


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


def test_chunk_sizes_that_share_their_buffers(pool: Buffers) -> None:
    """Buffers have a least size."""
    with closing(Provision(SIZE // 4, BUDGET)) as provision:
        comes(provision, 1e12)
        assert provision.chunk_size == SIZE
        assert pool._there == {SIZE: BUDGET // 2 // SIZE}


def test_where_there_is_no_memory_it_is_asked_for_once(
    pool: Buffers, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    new = pool_module._new

    def refuse(size: int) -> mmap.mmap:
        if size > SIZE:
            asked.append(size)
            raise OSError(errno.ENOMEM, "no memory")
        return new(size)

    monkeypatch.setattr(pool_module, "_new", refuse)
    with closing(Provision(SIZE, BUDGET)) as provision:
        there = pool._there[SIZE]
        comes(provision, 1e12, looks=10)
        assert asked == [4 * SIZE]
        assert provision.chunk_size == SIZE
        assert pool._there[SIZE] > there  # of what there is, more is got
        assert pool.take(SIZE).size == SIZE


def test_who_closes_does_not_wait_for_all_of_it(
    pool: Buffers, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_PAUSE", 1e9)
    with closing(Provision(SIZE, BUDGET)) as provision:
        provision.look(1e12)
        provision.look(1e12)
        wait_for(lambda: pool._there[4 * SIZE] == 1)
    assert provision._thread is not None
    assert not provision._thread.is_alive()
    assert pool._there[4 * SIZE] == 1


def test_memory_is_short_when_less_than_the_reserve_is_spare(pool: Buffers) -> None:
    with closing(Provision(SIZE, BUDGET)) as provision:
        there = pool._there[SIZE]
        held = [pool.take(SIZE) for _ in range(int(there * (1 - module._RESERVE)))]
        assert not provision.is_short()
        held.append(pool.take(SIZE))
        assert provision.is_short()
        held.clear()
        assert not provision.is_short()


def test_memory_of_either_size_may_be_short_while_chunks_become_larger(pool: Buffers) -> None:
    with closing(Provision(SIZE, BUDGET)) as provision:
        held = [pool.take(SIZE) for _ in range(pool._there[SIZE])]
        assert provision.is_short()
        comes(provision, 1e12)
        assert provision.chunk_size == 4 * SIZE
        assert provision.is_short()  # somebody may still take small ones
        comes(provision, 1e12, looks=1)
        assert not provision.is_short()
        held += [pool.take(4 * SIZE) for _ in range(pool._there[4 * SIZE])]
        assert provision.is_short()


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
        writer = recording._capture.writer

        def speak(one: Channel) -> None:
            n = 0
            while (writer.chunk_size == SIZE and time.monotonic() < until) or n % 20:
                written[one].append(text(bytes([n % 251]) * sizes[n % len(sizes)]))
                recording.write(one, written[one][-1], log_time=n)
                n += 1
                time.sleep(0.02)

        threads = [threading.Thread(target=speak, args=(one,)) for one in own]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert writer.chunk_size == 4 * SIZE
        assert pool._there[4 * SIZE]
    for one in own:
        assert [m.raw for m in store.topic(one.topic)] == written[one]
    assert store.verify().findings == []
