"""Gaps in `header.seq`: ROS 1 and Foxglove must report the same losses for the same numbers."""

from __future__ import annotations

import asyncio
import socket
import struct
from collections.abc import Callable, Sequence

import pytest

from hybridlog.live.sources.base import Cause
from hybridlog.live.sources.foxglove.connection import Session
from hybridlog.live.sources.foxglove.protocol import MESSAGE_DATA
from hybridlog.live.sources.ros1.stream import Stream
from hybridlog.live.sources.sequence_gaps import SequenceGap, SequenceGapDetector
from hybridlog_storage.messages import Channel, Schema
from tests.live.sources.heard import Heard
from tests.live.sources.ros1_peers import framed

MODULUS = 1 << 32
DEFINITION = "Header header\nfloat32 x"


def payload(number: int) -> bytes:
    return struct.pack("<I", number % MODULUS) + b"rest"


def detected(numbers: Sequence[int]) -> list[SequenceGap]:
    detector = SequenceGapDetector()
    found = []
    for at, number in enumerate(numbers):
        detector.see(number % MODULUS, at)
        found += detector.confirmed()
    return found + detector.finish()


def reported(heard: Heard) -> int:
    assert {(loss.topic, loss.cause) for loss in heard.losses} <= {("/a", Cause.TRANSPORT)}
    assert all(loss.count is not None and loss.count > 0 for loss in heard.losses)
    return sum(loss.count or 0 for loss in heard.losses)


# All that find gaps, each with the missing messages that it reports.


def by_the_detector(numbers: Sequence[int]) -> int:
    return sum(gap.missing for gap in detected(numbers))


def by_ros1(numbers: Sequence[int], *, at_once: bool) -> int:
    channel = Channel("/a", "ros1", Schema("a/B", "ros1msg", DEFINITION.encode()))
    heard = Heard()
    ours, peer = socket.socketpair()
    ours.setblocking(False)
    with peer:
        stream = Stream(ours, channel, heard, 1 << 20, lambda _: None)
        frames = [framed(payload(number)) for number in numbers]
        for data in [b"".join(frames)] if at_once else frames:
            peer.sendall(data)
            assert stream.read()
    while stream.read():
        pass
    stream.close()
    assert [taken.sequence for taken in heard.taken] == [number % MODULUS for number in numbers]
    return reported(heard)


def by_ros1_one_by_one(numbers: Sequence[int]) -> int:
    return by_ros1(numbers, at_once=False)


def by_ros1_at_once(numbers: Sequence[int]) -> int:
    return by_ros1(numbers, at_once=True)


class Unanswered(Session):
    """A session of a server that hears nothing."""

    def _send(self, operation: str, **values: object) -> None:
        pass


def heard_by_foxglove(*payloads: bytes) -> Heard:
    heard = Heard()

    async def hear() -> None:
        session = Unanswered(heard, "server", {}, lambda: None)
        session._advertise(
            [{"id": 1, "topic": "/a", "encoding": "ros1", "schemaName": "T", "schema": DEFINITION}]
        )
        for one in payloads:
            session._binary(struct.pack("<BIQ", MESSAGE_DATA, 0, 1) + one)
        session.end(is_stopped=True)

    asyncio.run(hear())
    assert len(heard.taken) == len(payloads)
    return heard


def by_foxglove(numbers: Sequence[int]) -> int:
    return reported(heard_by_foxglove(*map(payload, numbers)))


USERS = [by_the_detector, by_ros1_one_by_one, by_ros1_at_once, by_foxglove]


@pytest.mark.parametrize("missing_of", USERS)
@pytest.mark.parametrize(
    ("numbers", "missing"),
    [
        (range(1000), 0),
        ([*range(20), *range(25, 50)], 5),
        ([*range(100), *range(110, 200)], 10),
        ([*range(9), 12], 3),
        ([*range(8), 12], 0),  # too few messages to trust the numbers
        ([*range(8), *range(20, 100)], 0),
        ([*range(9), 12, 13, 15, 17], 5),  # trust survives a gap
        ([*range(100), *range(100, 400, 3)], 2 * 99),  # gaps close together
        ([*range(MODULUS - 10, MODULUS), 0, 1, 3], 1),  # wraps
        ([*range(-100, -1), *range(5, 100)], 6),  # wraps within a gap
        ([0] * 1000, 0),  # not numbered
        ([*range(20), 5, 9, 30], 0),  # goes back, which ends the trust
        ([*range(20), 19, 25], 0),  # repeats
        ([*range(20), 5, *range(6, 14), 16], 2),  # trusted again
        ([*range(100), *range(50)], 0),  # begins anew
        (range(0, 10_000, 10), 0),  # throttled
        ([*range(20), 2_000_020, 2_000_025], 0),  # too wide
        ([*range(100), *range(1 << 20, (1 << 20) + 100)], 0),
        ([*range(20), 1_000_020], 1_000_000),  # as wide as can be
        ([*range(20), 1_000_021], 0),
        ([7, 1, 9, 2, 8], 0),
        # Two publishers alternate.
        ([n for pair in zip(range(500), range(90_000, 90_500), strict=True) for n in pair], 0),
        # A second publisher sends a few messages.
        ([*range(100), *range(5000, 5004), *range(100, 200)], 0),
        ([*range(100), *range(5000, 5008), *range(100, 200)], 0),
    ],
)
def test_all_report_the_same_losses(
    missing_of: Callable[[Sequence[int]], int], numbers: Sequence[int], missing: int
) -> None:
    assert missing_of(numbers) == missing


def test_a_gap_lies_between_two_messages() -> None:
    assert detected([*range(100), *range(110, 200)]) == [SequenceGap(10, 99, 100)]
    assert detected([*range(MODULUS - 20, MODULUS), 3]) == [SequenceGap(3, 19, 20)]


@pytest.mark.parametrize("data", [b"", b"abc"])
def test_a_payload_without_room_for_a_number_is_ignored(data: bytes) -> None:
    heard = heard_by_foxglove(*map(payload, range(20)), data, payload(20))
    assert heard.losses == []
