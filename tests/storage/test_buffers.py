"""Buffers that are used again."""

from __future__ import annotations

import gc
import mmap
import resource
from typing import Any

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from hybridlog_storage import buffers as module
from hybridlog_storage.buffers import Buffers
from tests.calls import Calls
from tests.waiting import at_once

SIZE = 1 << 20
LARGE = 8 << 20
FEW = module._MAX_IDLE_BYTES // LARGE


@pytest.fixture
def made(calls: Calls) -> list[int]:
    """Bytes of each buffer that the system was asked for."""
    asked: list[int] = []
    calls(module, "new_memory", asked.append)
    return asked


def test_a_bounded_number_of_bytes_is_idle_and_the_oldest_go_first(made: list[int]) -> None:
    pool = Buffers()
    held = [pool.take(LARGE) for _ in range(FEW + 5)]
    del held
    held = [pool.take(LARGE) for _ in range(FEW)]
    assert made == [LARGE] * (FEW + 5)
    held.append(pool.take(LARGE))
    assert made == [LARGE] * (FEW + 6)
    other = pool.take(SIZE)
    del held, other  # sizes that nobody takes any more do not stay for ever
    held = [pool.take(SIZE), pool.take(2 * module._MAX_IDLE_BYTES)]
    assert len(made) == FEW + 8
    del held
    again = [pool.take(LARGE) for _ in range(FEW - 1)]
    assert len(again) == FEW - 1
    assert len(made) == FEW + 8


def test_a_buffer_may_be_given_back_while_another_is_taken() -> None:
    """The collector runs where it likes, also on a thread that is taking one."""
    pool = Buffers()

    def take() -> None:
        for number in range(300):
            array = pool.take(SIZE)
            array[:: mmap.PAGESIZE] = number % 251
            knot: list[Any] = [array]
            knot.append(knot)  # only the collector can take it away
            assert (array[:: mmap.PAGESIZE] == number % 251).all()
            del array, knot
            if number % 10 == 0:
                gc.collect()

    at_once(*[take] * 4)
    assert sum(map(len, pool._idle)) <= module._MAX_IDLE_BYTES


class Taking(RuleBasedStateMachine):
    """No two buffers share a byte."""

    def __init__(self) -> None:
        super().__init__()
        self.pool = Buffers()
        self.held: list[tuple[np.ndarray[Any, np.dtype[np.uint8]], int]] = []
        self.number = 0

    @rule(size=st.sampled_from([1 << 18, 300_000, SIZE, LARGE // 2 + 1, LARGE + 1]))
    def take(self, size: int) -> None:
        array = self.pool.take(size)
        assert len(array) >= size
        assert not array.ctypes.data % mmap.PAGESIZE
        self.number = (self.number + 1) % 251
        array[:: mmap.PAGESIZE] = self.number
        self.held.append((array, self.number))

    @rule(which=st.integers(0, 1 << 20))
    def drop(self, which: int) -> None:
        if self.held:
            array, number = self.held.pop(which % len(self.held))
            assert (array[:: mmap.PAGESIZE] == number).all()

    @invariant()
    def adds_up(self) -> None:
        assert sum(map(len, self.pool._idle)) <= module._MAX_IDLE_BYTES

    def teardown(self) -> None:
        while self.held:
            self.drop(0)


TestTaking = Taking.TestCase
TestTaking.settings = settings(max_examples=30, stateful_step_count=40, deadline=None)


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
