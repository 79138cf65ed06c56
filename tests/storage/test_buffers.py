"""Buffers that are used again."""

from __future__ import annotations

import mmap
import resource
import threading

import numpy as np
import pytest

from hybridlog_storage import buffers as module
from hybridlog_storage.buffers import Buffers

SIZE = 1 << 20


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Bytes of each buffer that the system was asked for."""
    asked: list[int] = []
    new = module._new

    def count(size: int) -> mmap.mmap:
        asked.append(size)
        return new(size)

    monkeypatch.setattr(module, "_new", count)
    return asked


def test_what_was_prepared_is_taken(made: list[int]) -> None:
    pool = Buffers()
    pool.prepare(SIZE - 5, 4 * SIZE)
    assert made == [SIZE] * 4
    held = [pool.take(SIZE - 5) for _ in range(4)]
    assert made == [SIZE] * 4
    held.append(pool.take(SIZE))
    assert made == [SIZE] * 5
    starts = {array.ctypes.data for array in held}
    assert len(starts) == 5
    assert not any(start % mmap.PAGESIZE for start in starts)


def test_nothing_is_prepared_where_one_is_too_much(made: list[int]) -> None:
    Buffers().prepare(2 * SIZE, SIZE)
    assert made == []


def test_a_buffer_is_not_taken_again_while_something_lies_over_it(made: list[int]) -> None:
    pool = Buffers()
    first = pool.take(SIZE)
    first[:] = 7
    view = memoryview(first)[10:20]
    del first
    pool.take(SIZE)[:] = 9
    assert bytes(view) == bytes([7] * 10)
    view.release()
    kept = [pool.take(SIZE), pool.take(SIZE)]
    assert len(made) == 2
    assert {int(np.max(array)) for array in kept} == {7, 9}


def test_no_more_is_kept_than_the_bound(made: list[int]) -> None:
    pool = Buffers()
    most = module._SPARE_BYTES // SIZE
    held = [pool.take(SIZE) for _ in range(most + 3)]
    del held
    del made[:]
    held = [pool.take(SIZE) for _ in range(most + 3)]
    assert len(made) == 3
    del held


def test_what_was_prepared_is_kept_until_things_settle(made: list[int]) -> None:
    pool = Buffers()
    usual = module._SPARE_BYTES // SIZE
    pool.prepare(SIZE, (usual + 5) * SIZE)
    assert len(made) == usual + 5
    held = [pool.take(SIZE) for _ in range(usual + 5)]
    del held
    # Those that are taken count: nothing is made on top of them.
    held = [pool.take(SIZE) for _ in range(10)]
    pool.prepare(SIZE, (usual + 5) * SIZE)
    assert len(made) == usual + 5
    del held
    pool.settle()
    held = [pool.take(SIZE) for _ in range(usual + 5)]
    assert len(made) == usual + 10
    pool.prepare(SIZE, (usual + 7) * SIZE)
    assert len(made) == usual + 12
    del held


def test_what_is_spare_of_another_size_is_not_in_the_way(made: list[int]) -> None:
    pool = Buffers()
    held = [pool.take(SIZE) for _ in range(module._SPARE_BYTES // SIZE)]
    del held
    del made[:]
    pool.prepare(2 * SIZE, 6 * SIZE)
    assert made == [2 * SIZE] * 3
    held = [pool.take(2 * SIZE) for _ in range(3)]
    assert len(made) == 3
    del held


def test_spare_buffers_of_one_size_are_given_back(made: list[int]) -> None:
    pool = Buffers()
    held = [pool.take(SIZE) for _ in range(4)]
    pool.prepare(2 * SIZE, 4 * SIZE)
    del held[1:]
    pool.release(SIZE, keep=SIZE - 5)
    assert dict(pool._there) == {SIZE: 4, 2 * SIZE: 2}
    pool.release(SIZE, keep=2 * SIZE)
    assert dict(pool._there) == {SIZE: 1, 2 * SIZE: 2}
    assert pool._spare_bytes == 4 * SIZE
    del made[:]
    held += [pool.take(SIZE), pool.take(2 * SIZE)]
    assert made == [SIZE]


def test_whether_few_buffers_are_spare() -> None:
    pool = Buffers()
    assert not pool.is_short(SIZE, 0.5)
    held = [pool.take(SIZE) for _ in range(4)]
    assert pool.is_short(SIZE, 0.5)
    held.pop()
    assert pool.is_short(SIZE, 0.5)
    held.pop()
    assert not pool.is_short(SIZE, 0.5)
    assert pool.is_short(SIZE - 5, 0.51)


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
    pool.prepare(8 << 20, 80 << 20, pause=3, enough=Enough())
    assert waited == [3.0] * 6
    assert made == [8 << 20] * 2
    # The one that was begun can be taken, too.
    held = [pool.take(8 << 20) for _ in range(2)]
    assert made == [8 << 20] * 2
    held.append(pool.take(8 << 20))
    assert made == [8 << 20] * 3


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
