"""Buffers that are used again."""

from __future__ import annotations

import mmap
import resource
import threading
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from hybridlog_storage import buffers as module
from hybridlog_storage.buffers import SLAB, Buffers
from tests.calls import Calls

SIZE = 1 << 20


@pytest.fixture
def made(calls: Calls) -> list[int]:
    """Bytes of each buffer that the system was asked for."""
    asked: list[int] = []
    calls(module, "new_memory", asked.append)
    return asked


def test_what_was_prepared_is_taken(made: list[int]) -> None:
    pool = Buffers()
    pool.prepare(SIZE - 5, 2 * SLAB)
    assert made == [SLAB] * 2
    held = [pool.take(SIZE - 5) for _ in range(16)]
    assert made == [SLAB] * 2
    held.append(pool.take(SIZE))
    assert made == [SLAB] * 3
    starts = sorted(array.ctypes.data for array in held)
    assert all(after - before >= SIZE for before, after in pairwise(starts))
    assert not any(start % mmap.PAGESIZE for start in starts)


def test_preparing_ends_when_somebody_settles_meanwhile(made: list[int]) -> None:
    class Enough(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            pool.settle()
            return False

    pool = Buffers()
    pool.prepare(SIZE, 2 * module._MAX_IDLE_BYTES, enough=Enough())
    assert len(made) == 2 * module._MAX_IDLE_BYTES // SLAB
    assert pool._given == {SLAB: module._MAX_IDLE_BYTES}


def test_nothing_is_prepared_where_one_is_too_much(made: list[int]) -> None:
    Buffers().prepare(2 * SIZE, SIZE)
    assert made == []


def test_a_buffer_is_not_taken_again_while_something_lies_over_it(made: list[int]) -> None:
    pool = Buffers()
    first = pool.take(SLAB)
    first[:] = 7
    view = memoryview(first)[10:20]
    del first
    pool.take(SLAB)[:] = 9
    assert bytes(view) == bytes([7] * 10)
    view.release()
    kept = [pool.take(SLAB), pool.take(SLAB)]
    assert len(made) == 2
    assert {int(np.max(array)) for array in kept} == {7, 9}


def test_memory_of_small_buffers_serves_for_large_ones_when_none_is_taken(
    made: list[int],
) -> None:
    pool = Buffers()
    held = [pool.take(SIZE) for _ in range(16)]
    assert made == [SLAB] * 2
    del held[1:]  # the first one is of the first slab
    large = pool.take(4 * SIZE)
    small = [pool.take(SIZE) for _ in range(7)]
    assert made == [SLAB] * 2
    del held, large, small
    assert len({pool.take(SLAB).ctypes.data for _ in range(3)}) == 1
    held = [pool.take(SLAB) for _ in range(2)]
    assert made == [SLAB] * 2
    del held


def test_buffers_beyond_a_slab_have_their_own(made: list[int]) -> None:
    pool = Buffers()
    held = [pool.take(SLAB + 1)]
    assert made == [2 * SLAB]
    del held
    held = [pool.take(SIZE), pool.take(2 * SLAB)]
    assert made == [2 * SLAB, SLAB]
    pool.prepare(2 * SLAB, 4 * SLAB)
    assert made == [2 * SLAB, SLAB, 2 * SLAB]
    del held


def test_what_was_prepared_is_kept_until_things_settle(made: list[int]) -> None:
    pool = Buffers()
    usual = module._MAX_IDLE_BYTES // SLAB
    pool.prepare(SIZE, (usual + 5) * SLAB)
    assert len(made) == usual + 5
    held = [pool.take(SLAB) for _ in range(usual + 5)]
    del held
    # Those that are taken count: nothing is made on top of them.
    held = [pool.take(SIZE) for _ in range(10)]
    pool.prepare(SIZE, (usual + 5) * SLAB)
    assert len(made) == usual + 5
    del held
    pool.settle()
    assert pool._given == {SLAB: usual * SLAB}
    held = [pool.take(SLAB) for _ in range(usual + 5)]
    assert len(made) == usual + 10
    pool.prepare(SIZE, (usual + 7) * SLAB)
    assert len(made) == usual + 12
    del held


def test_whether_little_memory_is_spare() -> None:
    pool = Buffers()
    assert pool.is_short(SIZE, 0)
    pool.prepare(SIZE, 4 * SIZE)
    held = [pool.take(SIZE) for _ in range(4)]
    assert pool.is_short(SIZE, 0.5)
    held.pop()
    assert pool.is_short(SIZE, 0.5)
    held.pop()
    assert not pool.is_short(SIZE, 0.5)
    assert pool.is_short(SIZE - 5, 0.51)
    assert pool.is_short(2 * SIZE, 0)  # spare, but not at one place
    del held
    assert not pool.is_short(2 * SIZE, 1)
    assert pool.is_short(SLAB, 0)  # the system has not given so much
    assert pool.is_short(2 * SLAB, 0)


def test_a_buffer_that_is_given_back_in_the_middle_of_something(made: list[int]) -> None:
    """The collector runs where it likes, on a thread that may have the lock."""
    pool = Buffers()
    held = pool.take(SLAB)
    with pool._lock:
        del held
    assert pool.take(SLAB).size == SLAB
    assert len(made) == 1


class Taking(RuleBasedStateMachine):
    """No two buffers share a byte, and all memory is accounted for."""

    def __init__(self) -> None:
        super().__init__()
        self.pool = Buffers()
        self.held: list[tuple[np.ndarray[Any, np.dtype[np.uint8]], int]] = []
        self.number = 0

    @rule(size=st.sampled_from([1 << 18, 300_000, SIZE, 2 * SIZE, SLAB // 2 + 1, SLAB + 1]))
    def take(self, size: int) -> None:
        array = self.pool.take(size)
        assert len(array) >= size
        self.number = (self.number + 1) % 251
        array[:: mmap.PAGESIZE] = self.number
        self.held.append((array, self.number))

    @rule(which=st.integers(0, 1 << 20))
    def drop(self, which: int) -> None:
        if self.held:
            array, number = self.held.pop(which % len(self.held))
            assert (array[:: mmap.PAGESIZE] == number).all()

    @rule(size=st.sampled_from([1 << 18, 4 * SIZE]), total=st.integers(0, 4 * SLAB))
    def prepare(self, size: int, total: int) -> None:
        before = self.pool._given[SLAB]
        self.pool.prepare(size, total)
        assert total - module._rounded(size) < self.pool._given[SLAB] <= max(before, total)

    @rule()
    def settle(self) -> None:
        self.pool.settle()

    @invariant()
    def adds_up(self) -> None:
        pool = self.pool
        for kind in (SLAB, 2 * SLAB):
            taken = sum(len(array) for array, _ in self.held if max(len(array), SLAB) == kind)
            assert pool._taken[kind] == taken
            assert pool._given[kind] >= taken
        whole = sum(slab.size for slabs in pool._whole.values() for slab in slabs)
        assert whole == pool._whole_bytes <= pool._most_whole
        if not self.held:
            assert not any(pool._cut.values())

    def teardown(self) -> None:
        while self.held:
            self.drop(0)


TestTaking = Taking.TestCase
TestTaking.settings = settings(max_examples=30, stateful_step_count=40, deadline=None)


def test_memory_is_got_with_pauses_and_ended_in_one(
    made: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pause after each huge page, since whoever records is held up as long as one takes."""
    waited: list[float] = []

    class Enough(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            assert timeout is not None
            waited.append(timeout)
            if len(waited) == 6:
                self.set()
            return self.is_set()

    class Time:
        def __init__(self) -> None:
            self.now = 0.0

        def monotonic(self) -> float:
            self.now += 1
            return self.now

    monkeypatch.setattr(module, "time", Time())
    pool = Buffers()
    pool.prepare(SLAB, 10 * SLAB, pause=3, enough=Enough())
    assert waited == [3.0] * 6
    assert made == [SLAB] * 2
    # What was begun can be taken, too.
    held = [pool.take(SLAB) for _ in range(2)]
    assert made == [SLAB] * 2
    held.append(pool.take(SLAB))
    assert made == [SLAB] * 3


def test_new_memory_is_there_when_it_is_taken() -> None:
    """Or whoever lays down messages would wait for it, and others with him."""
    pool = Buffers()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    array = pool.take(8 << 20)
    after = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    assert after > before
    array[:] = 1
    # Not one a page of those that were written to.
    assert resource.getrusage(resource.RUSAGE_SELF).ru_minflt - after < 100
