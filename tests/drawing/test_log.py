"""Lines of text logs against those that were written."""

from __future__ import annotations

import pytest

import hybridlog as hl
from hybridlog.drawing.log import LEVELS, Line, Log, kind_of
from hybridlog_storage.errors import UsageError
from tests.odd_messages import HOSTILE, LOGS, START, log_time

TOPICS = {
    "/rosout": "rosgraph_msgs/Log",
    "/rosout2": "rcl_interfaces/msg/Log",
    "/fox": "foxglove.Log",
    HOSTILE: "std_msgs/String",
}


def log_of(odd: hl.Store, topic: str, level: str = "", text: str = "") -> Log:
    return Log(odd.query([topic]), kind_of(TOPICS[topic]), level, text)


def written(topic: str, numbers: range) -> list[tuple[int, str, str, str]]:
    found = []
    for n in numbers:
        level, name, text = LOGS[n]
        is_plain = topic == HOSTILE
        found.append(
            (log_time(n), "" if is_plain else LEVELS[level], "" if is_plain else name, text)
        )
    return found


def told(lines: list[Line]) -> list[tuple[int, str, str, str]]:
    return [(line.time, line.level, line.name, line.text) for line in lines]


@pytest.mark.parametrize("topic", TOPICS)
def test_pages_of_lines_meet_without_missing_or_repeating_one(odd: hl.Store, topic: str) -> None:
    """Pages of 7 lines, while 5 lines share each time."""
    log = log_of(odd, topic)
    found: list[Line] = []
    time, seq = 0, -1
    while page := log.after(time, seq, 7):
        found += page
        time, seq = page[-1].time, page[-1].seq
    if topic == "/rosout":
        cut = found.pop()
        assert (cut.is_readable, cut.time) == (False, log_time(len(LOGS)))
        assert "cannot be read" in cut.text
    assert told(found) == written(topic, range(len(LOGS)))
    assert all(line.is_readable and line.is_whole for line in found)
    back: list[Line] = []
    time, seq = found[-1].time + 1, 0
    while page := log.before(time, seq, 7):
        back = page + back
        time, seq = page[0].time, page[0].seq
    assert back == found


def test_lines_around_a_line(odd: hl.Store) -> None:
    log = log_of(odd, "/rosout2")
    seq = log.after(log_time(100), -1, 3)[2].seq
    assert told(log.before(log_time(102), seq, 4)) == written("/rosout2", range(98, 102))
    assert told(log.after(log_time(102), seq, 4)) == written("/rosout2", range(103, 107))
    assert log.before(START, -1, 5) == []
    assert log.after(START * 2, -1, 5) == []


@pytest.mark.parametrize("topic", [name for name in TOPICS if name != HOSTILE])
@pytest.mark.parametrize("level", ["debug", "warning", "fatal"])
def test_lines_of_a_level_and_above(odd: hl.Store, topic: str, level: str) -> None:
    log = log_of(odd, topic, level)
    wanted = [
        row for row in written(topic, range(len(LOGS))) if row[1] in LEVELS[LEVELS.index(level) :]
    ]
    assert told(log.after(0, -1, 1000)) == wanted
    assert log.count() == len(wanted)


@pytest.mark.parametrize(
    "text",
    ["line 12", "LINE 12", '"quoted" \\', "(100%)", "é\n<b>", ".*", "[", "...", "NODE_2", "\0"],
)
def test_lines_with_a_text(odd: hl.Store, text: str) -> None:
    for topic in ("/rosout", "/fox", HOSTILE):
        log = log_of(odd, topic, text=text)
        wanted = [
            row
            for row in written(topic, range(len(LOGS)))
            if text.lower() in row[2].lower() or text.lower() in row[3].lower()
        ]
        assert told(log.after(0, -1, 1000)) == wanted


def test_other_types_are_refused() -> None:
    for name in ("sensor_msgs/Imu", "", "std_msgs/msg/Strings"):
        with pytest.raises(UsageError, match="no text log"):
            kind_of(name)
