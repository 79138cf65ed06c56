"""Memory for what will come, and chunks as large as suits the rate."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog.live import provision as module
from hybridlog.live.provision import Provision
from hybridlog_storage import buffers as pool_module
from hybridlog_storage.buffers import Buffers
from hybridlog_storage.messages import Channel
from hybridlog_storage.segment_writer import RecordingWriter, SegmentSettings
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


@pytest.fixture
def store(tmp_path: Path) -> Iterator[hl.Store]:
    with hl.open(tmp_path / "store", create=True, require_database=True) as opened:
        yield opened


@pytest.fixture
def writer(tmp_path: Path) -> Iterator[RecordingWriter]:
    made = RecordingWriter(tmp_path, {}, lambda *_: None, SegmentSettings(chunk_size=SIZE))
    yield made
    made.abort()


def comes(provision: Provision, rate: float) -> None:
    """So much comes for so long that all is done that is to be done about it."""
    for _ in range(2):
        provision.look(rate)
        wait_for(lambda: provision._thread is None or not provision._thread.is_alive())


def test_an_eighth_of_the_budget_is_there_before_the_first_message(
    pool: Buffers, writer: RecordingWriter
) -> None:
    with closing(Provision(writer, BUDGET)) as provision:
        assert pool._there[SIZE] == BUDGET // 8 // SIZE
        comes(provision, 0)
        comes(provision, BUDGET / 8)
        assert provision._thread is None


@pytest.mark.usefixtures("pool")
def test_nothing_is_done_while_it_is_not_known_how_much_will_come(writer: RecordingWriter) -> None:
    with closing(Provision(writer, BUDGET)) as provision:
        for rate in [1e6, 1e8, 1e9, 2e9]:
            provision.look(rate)
        assert provision._thread is None
        comes(provision, 2e9)
        assert writer.chunk_size == 4 * SIZE


def test_as_much_as_comes_while_a_disk_stands_still_but_no_more_than_half_the_budget(
    pool: Buffers, writer: RecordingWriter
) -> None:
    rate = 0.5 * BUDGET
    with closing(Provision(writer, BUDGET)) as provision:
        comes(provision, rate)
        assert pool._there[SIZE] == rate * module._AHEAD_S // SIZE
        comes(provision, 100 * BUDGET)
        assert writer.chunk_size == 4 * SIZE
        assert pool._there == {SIZE: 0, 4 * SIZE: BUDGET // 2 // (4 * SIZE)}
    assert pool._spare_bytes <= pool_module._SPARE_BYTES


@pytest.mark.parametrize(
    ("rate", "times"), [(MUCH / 2, 1), (MUCH / 2 + 1, 2), (MUCH, 2), (MUCH + 1, 4), (1e12, 4)]
)
@pytest.mark.usefixtures("pool")
def test_chunks_are_larger_where_they_would_be_too_many(
    writer: RecordingWriter, rate: float, times: int
) -> None:
    with closing(Provision(writer, BUDGET)) as provision:
        comes(provision, rate)
        assert writer.chunk_size == times * SIZE


@pytest.mark.usefixtures("pool")
def test_chunks_become_small_again_when_little_comes(writer: RecordingWriter) -> None:
    with closing(Provision(writer, BUDGET)) as provision:
        for rate, times in [(2 * MUCH, 4), (MUCH / 2 + 1, 4), (MUCH / 2 - 1, 1), (MUCH, 2)]:
            comes(provision, rate)
            assert writer.chunk_size == times * SIZE


@pytest.mark.usefixtures("pool")
def test_no_chunk_takes_much_of_the_budget(writer: RecordingWriter) -> None:
    with closing(Provision(writer, 2 * module._SHARE * SIZE - 1)) as provision:
        comes(provision, 1e12)
        assert writer.chunk_size == SIZE


def test_who_closes_does_not_wait_for_all_of_it(
    pool: Buffers, writer: RecordingWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_PAUSE", 1e9)
    with closing(Provision(writer, BUDGET)) as provision:
        provision.look(1e12)
        provision.look(1e12)
        wait_for(lambda: pool._there[4 * SIZE] == 1)
    assert provision._thread is not None
    assert not provision._thread.is_alive()
    assert pool._there[4 * SIZE] == 1


def test_memory_is_short_when_less_than_the_reserve_is_spare(
    pool: Buffers, writer: RecordingWriter
) -> None:
    with closing(Provision(writer, BUDGET)) as provision:
        there = pool._there[SIZE]
        held = [pool.take(SIZE) for _ in range(int(there * (1 - module._RESERVE)))]
        assert not provision.is_short()
        held.append(pool.take(SIZE))
        assert provision.is_short()
        held.clear()
        assert not provision.is_short()


def test_a_recording_of_much_has_larger_chunks(
    store: hl.Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And what is in them is what was written, in order."""
    monkeypatch.setattr(module, "_CHUNKS", 1)
    own = [channel(f"/talk{n}") for n in range(3)]
    sizes = [10, 20_000, 150_000, 300_000, 1 << 20]
    written: dict[Channel, list[bytes]] = {one: [] for one in own}
    settings = SegmentSettings(chunk_size=SIZE)
    with store.start("talk", budget_bytes=1 << 28, settings=settings) as recording:

        def speak(one: Channel) -> None:
            n = 0
            while recording._capture.writer.chunk_size == SIZE or n % 20:
                written[one].append(text(bytes([n % 251]) * sizes[n % len(sizes)]))
                recording.write(one, written[one][-1], log_time=n)
                n += 1
                time.sleep(0.005)

        threads = [threading.Thread(target=speak, args=(one,)) for one in own]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert recording._capture.writer.chunk_size == 4 * SIZE
    for one in own:
        assert [m.raw for m in store.topic(one.topic)] == written[one]
    assert store.verify().findings == []
