"""Damage of a recording that goes on: right answers, or errors, or words; never silence."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog_storage.errors import HybridlogError
from hybridlog_storage.mcap.mcap_content import MAGIC, RECORD_HEAD
from hybridlog_storage.segments.segment_format import (
    ARRIVAL_OPCODE,
)
from hybridlog_storage.segments.walk import Walk
from tests.running.methods import LABEL, rows, sent
from tests.running.running import Running, begun
from tests.running.sequence import Known
from tests.running.stores import as_running, copy_of, folder, open_segment


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with begun(tmp_path_factory.mktemp("running") / "store", "one", 120) as found:
        yield found


@pytest.fixture
def copied(running: Running, tmp_path: Path) -> Path:
    return copy_of(running, tmp_path / "copy")


def is_reported(store: hl.Store) -> bool:
    """Whether the store says that a part of a segment is damaged."""
    losses = store.entry(LABEL).losses
    return any(row["cause"] == "segment" and row["count"] is None for row in losses)


def outcome(store: Path, known: Known) -> str:
    """What comes of asking: `right`, `error`, `told` or `silent`."""
    found = set()
    with as_running(store) as opened:
        told = is_reported(opened)
        for topic in known.counts:
            wanted = known.of(topic)
            for ask, right in (
                (lambda t: rows(opened.topic(t)), sent(wanted)),
                (lambda t: opened.topic(t).count(), len(wanted)),
                (lambda t: opened.topic(t).between("+1s", "end").count(), None),
            ):
                try:
                    answer = ask(topic)  # type: ignore[no-untyped-call]
                except HybridlogError:
                    found.add("error")
                    continue
                if right is not None and answer != right:
                    found.add("told" if told else "silent")
    return next((word for word in ("silent", "told", "error") if word in found), "right")


def flip(path: Path, data: bytes, places: list[tuple[int, int]]) -> Iterator[tuple[int, int]]:
    """Flip bits, one after another."""
    for at, bit in places:
        changed = bytearray(data)
        changed[at] ^= 1 << bit
        path.write_bytes(changed)
        yield at, bit


def check_flips(running: Running, copied: Path, count: int, seed: int) -> Counter[str]:
    known = running.flushed()
    path = open_segment(copied)
    data = path.read_bytes()
    rng = random.Random(seed)
    heads = [at + n for at in record_starts(data) for n in range(RECORD_HEAD.size)]
    places = [(rng.randrange(len(data)), rng.randrange(8)) for _ in range(count)]
    places += [(rng.choice(heads), rng.randrange(8)) for _ in range(count)]
    found: Counter[str] = Counter()
    for at, bit in flip(path, data, places):
        result = outcome(copied, known)
        assert result != "silent", (at, bit)
        found[result] += 1
    path.write_bytes(data)
    assert outcome(copied, known) == "right"
    return found


def record_starts(data: bytes) -> list[int]:
    found, at = [], len(MAGIC)
    while at + RECORD_HEAD.size <= len(data) and data[at]:
        found.append(at)
        at += RECORD_HEAD.size + RECORD_HEAD.unpack_from(data, at)[1]
    return found


def test_flipped_bits_are_no_silence(running: Running, copied: Path) -> None:
    found = check_flips(running, copied, 12, 1)
    assert found["error"] > 2
    assert found["told"] > 2


@pytest.mark.exhaustive
@pytest.mark.parametrize("seed", range(20))
def test_many_flipped_bits(running: Running, copied: Path, seed: int) -> None:
    check_flips(running, copied, 300, seed + 2)


def test_a_torn_end_is_no_damage(running: Running, copied: Path) -> None:
    """A record that is not whole yet, and its room, are left out without a word."""
    known = running.flushed()
    path = open_segment(copied)
    data = path.read_bytes()
    starts = record_starts(data)
    rng = random.Random(3)
    cuts = {rng.randrange(len(MAGIC), len(data)) for _ in range(15)}
    cuts |= {start + n for start in rng.sample(starts, 6) for n in (0, 1, 9, 12, 40, 60)}
    before = 0
    for cut in sorted(cut for cut in cuts if cut <= len(data)):
        for room in (0, 4096):
            if room and not (cut in starts and data[cut] not in {7, ARRIVAL_OPCODE}):
                continue  # a writer leaves room behind whole chunks only
            path.write_bytes(data[:cut] + bytes(room))
            segment = Walk.opened(folder(copied), 0)
            segment.follow()
            assert segment.damaged == [], cut
        with as_running(copied) as store:
            entry = store.entry(LABEL)
            assert not is_reported(store), cut
            assert entry.messages >= before
            before = entry.messages
            there = Known(known.sent, entry.messages_by_topic())
            if there.sent:
                topics = [topic for topic, count in there.counts.items() if count]
                assert rows(store.query(topics)) == sent(there.of()), cut
    assert before > 0
