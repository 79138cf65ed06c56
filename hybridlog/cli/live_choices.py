"""The options of `hybridlog record` that are for a running robot, and what fits together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from hybridlog.cli import output
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from hybridlog.live.recorder import RecorderOptions
    from hybridlog.live.snapshots import SnapshotOptions
    from hybridlog.live.sources.base import LiveSource
    from hybridlog_storage.segment_writer import SegmentSettings

_SOURCES: Final = frozenset({"ros1", "ros2", "foxglove", "replay"})
_LEAST_SEGMENT: Final = 1 << 20
_LONGEST_FLUSH_S: Final = 3600.0
_DAY_S: Final = 86_400.0


@dataclass(frozen=True, slots=True)
class LiveChoices:
    """The options of the command that only live recording has, as typed."""

    ros1: bool = False
    master: str | None = None
    ros2: bool = False
    qos: Path | None = None
    foxglove: str | None = None
    replay: Path | None = None
    speed: float = 1.0
    duration: str | None = None
    max_messages: int | None = None
    max_size: str | None = None
    split_size: str | None = None
    split_duration: str | None = None
    budget: str | None = None
    reserve: str = "1GB"
    flush_interval: str = "1s"
    ring: str | None = None
    trigger: list[str] | None = None
    before: str | None = None
    after: str | None = None
    throttle: list[str] | None = None
    priority: list[str] | None = None

    @property
    def any_source(self) -> bool:
        """Whether something live was asked for."""
        return self.ros1 or self.ros2 or self.foxglove is not None or self.replay is not None

    @property
    def given(self) -> list[str]:
        """The options that say how, as far as they differ from what holds without them."""
        usual = asdict(LiveChoices())
        return [
            f"--{name.replace('_', '-')}"
            for name, value in asdict(self).items()
            if name not in _SOURCES and value != [] and value != usual[name]
        ]


def check_choices(live: LiveChoices, paths: Sequence[Path]) -> None:
    """Refuse what does not fit together.

    Raises:
        UsageError: A log and a robot at once, neither of them, or options of the other.
    """
    if paths and live.any_source:
        hint = ""
        if live.ros1 and live.master is None:
            hint = " A ROS master's URI looks like http://host:11311, and follows --ros1."
        raise UsageError(
            f"Give either logs to record or a robot (--ros1, --ros2, …), not both.{hint}"
        )
    if paths and live.given:
        are = "is" if len(live.given) == 1 else "are"
        raise UsageError(
            f"{_listed(live.given)} {are} for a running robot (--ros1, --ros2, --foxglove) or "
            "--replay, not for logs."
        )
    if not paths and not live.any_source:
        raise UsageError(
            "Nothing to record: give a log, or --ros1, --ros2, --foxglove URL or --replay FILE."
        )
    if live.master is not None and not live.master.strip():
        raise UsageError("A ROS master's URI looks like http://host:11311; this one is empty.")
    if live.qos is not None and not live.ros2:
        raise UsageError("--qos is for --ros2.")
    if "--speed" in live.given and live.replay is None:
        raise UsageError("--speed is for --replay.")


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def recorder_options(
    live: LiveChoices,
    *,
    name: str | None,
    tags: dict[str, str],
    topics: Sequence[str],
    exclude: Sequence[str],
    settings: SegmentSettings,
) -> RecorderOptions:
    """What to record and how.

    Raises:
        UsageError: An option that makes no sense.
        TopicError: A pattern that is malformed.
    """
    from hybridlog.live.budget import MIN_USER_BUDGET, default_budget
    from hybridlog.live.policy import priority_rule, throttle_rule
    from hybridlog.live.recorder import RecorderOptions
    from hybridlog.query.topics import matcher

    if live.split_size is not None:
        least = _LEAST_SEGMENT
        settings = replace(settings, segment_size=_size("--split-size", live.split_size, least))
    if live.split_duration is not None:
        settings = replace(settings, segment_span_s=_seconds(live.split_duration))
    flush_interval_s = _seconds(live.flush_interval)
    if not 0 < flush_interval_s <= _LONGEST_FLUSH_S:
        raise UsageError("--flush-interval must be longer than 0, and at most an hour.")
    return RecorderOptions(
        name=name or _name(live),
        tags=tags,
        matcher=matcher(topics, exclude) if topics or exclude else None,
        throttles=[throttle_rule(*_pair("--throttle", "RATE", t)) for t in live.throttle or ()],
        priorities=[priority_rule(*_pair("--priority", "WORD", t)) for t in live.priority or ()],
        duration_s=None if live.duration is None else _positive("--duration", live.duration),
        max_messages=live.max_messages,
        max_bytes=None if live.max_size is None else _size("--max-size", live.max_size, 1),
        reserve_bytes=_size("--reserve", live.reserve),
        budget_bytes=default_budget()
        if live.budget is None
        else _size("--budget", live.budget, MIN_USER_BUDGET),
        flush_interval_s=flush_interval_s,
        settings=settings,
        snapshots=_snapshots(live),
    )


def _snapshots(live: LiveChoices) -> SnapshotOptions | None:
    from hybridlog.live.snapshots import SnapshotOptions, Trigger

    if live.ring is None:
        if live.trigger or live.before is not None or live.after is not None:
            raise UsageError("--trigger, --before and --after are for --ring.")
        return None
    ring_s = _positive("--ring", live.ring)
    if ring_s > _DAY_S:
        raise UsageError("--ring must be at most a day.")
    return SnapshotOptions(
        ring_s,
        None if live.before is None else _seconds(live.before),
        0.0 if live.after is None else _seconds(live.after),
        tuple(Trigger.of(text) for text in live.trigger or ()),
    )


def _pair(option: str, value_name: str, text: str) -> tuple[str, str]:
    pattern, sign, value = text.rpartition("=")
    if not sign or not pattern:
        raise UsageError(
            f"{option} wants a topic and a value ({option} TOPIC {value_name}), not "
            f"{output.quoted(text)}."
        )
    return pattern, value


def _size(option: str, text: str, least: int = 0) -> int:
    try:
        size = output.parse_size(text)
    except UsageError as error:
        raise UsageError(f"{option}: {error}") from error
    if size < least:
        raise UsageError(f"{option} must be at least {_whole(least)}, not {text}.")
    return size


def _whole(size: int) -> str:
    return f"{size >> 20} MiB" if size >= 1 << 20 else f"{size} B"


def _positive(option: str, text: str) -> float:
    seconds = _seconds(text)
    if not seconds:
        raise UsageError(f"{option} must be longer than 0.")
    return seconds


def _seconds(text: str) -> float:
    from hybridlog.query.times import parse_duration

    return parse_duration(text) / 1e9


def _name(live: LiveChoices) -> str:
    if live.replay is not None:
        return live.replay.stem or "replay"
    return "ros1" if live.ros1 else "ros2" if live.ros2 else "foxglove"


def sources_of(live: LiveChoices) -> list[LiveSource]:
    """What was asked for; each loads what it needs.

    Raises:
        UsageError: A setting that is none.
    """
    found: list[LiveSource] = []
    if live.ros1:
        from hybridlog.live.sources.ros1.source import Ros1Source

        found.append(Ros1Source(live.master))
    if live.ros2:
        from hybridlog.live.sources.ros2.source import Ros2Source

        found.append(Ros2Source(qos_overrides=live.qos))
    if live.foxglove is not None:
        from hybridlog.live.sources.foxglove.source import FoxgloveSource

        found.append(FoxgloveSource(live.foxglove))
    if live.replay is not None:
        from hybridlog.live.sources.replay import ReplaySource

        found.append(ReplaySource(live.replay, speed=live.speed))
    return found
