"""Options of the live recorder, and its sources, from the parameters of `hybridlog record`."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from hybridlog.cli import output
from hybridlog.cli.options import parse_tags
from hybridlog.cli.record_choices import DEFAULT_CHUNK, RecordChoices, segment_settings
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from hybridlog.live.recorder import RecorderOptions
    from hybridlog.live.sources.base import LiveSource

_MIN_SEGMENT: Final = 1 << 20
_MIN_CHUNK: Final = 1 << 19
_MAX_FLUSH_S: Final = 3600.0


def recorder_options(choices: RecordChoices) -> RecorderOptions:
    """Options of the recorder.

    Raises:
        UsageError: A value is out of range.
        TopicError: A pattern that is malformed.
    """
    from hybridlog.contract import Contract
    from hybridlog.live.memory import MIN_USER_BUDGET, default_budget
    from hybridlog.live.policy import priority_rule, throttle_rule
    from hybridlog.live.recorder import RecorderOptions
    from hybridlog.live.triggers import Trigger
    from hybridlog.query.topics import matcher

    budget_bytes = (
        default_budget()
        if choices.budget is None
        else _size("--budget", choices.budget, MIN_USER_BUDGET)
    )
    # Each topic of large messages has an open chunk, and all of them are to fit.
    chunk_size = min(max(budget_bytes >> 8, _MIN_CHUNK), DEFAULT_CHUNK)
    settings = replace(
        segment_settings(choices, chunk_size),
        segment_size=_size("--split-size", choices.split_size, _MIN_SEGMENT),
        segment_span_s=_seconds(choices.split_duration),
    )
    flush_interval_s = _seconds(choices.flush_interval)
    if not 0 < flush_interval_s <= _MAX_FLUSH_S:
        raise UsageError("--flush-interval must be longer than 0, and at most an hour.")
    return RecorderOptions(
        name=choices.name or _name(choices),
        tags=parse_tags(choices.set_tag),
        matcher=matcher(choices.topics, choices.exclude)
        if choices.topics or choices.exclude
        else None,
        throttles=[throttle_rule(*_pair("--throttle", "RATE", t)) for t in choices.throttle],
        priorities=[priority_rule(*_pair("--priority", "WORD", t)) for t in choices.priority],
        duration_s=None if choices.duration is None else _positive("--duration", choices.duration),
        max_messages=choices.max_messages,
        max_bytes=None if choices.max_size is None else _size("--max-size", choices.max_size, 1),
        reserve_bytes=_size("--reserve", choices.reserve),
        budget_bytes=budget_bytes,
        flush_interval_s=flush_interval_s,
        settings=settings,
        ring_s=None if choices.ring is None else _positive("--ring", choices.ring),
        triggers=[Trigger.of(text) for text in choices.trigger],
        before_s=None if choices.before is None else _seconds(choices.before),
        after_s=0.0 if choices.after is None else _seconds(choices.after),
        no_index=matcher(choices.no_index) if choices.no_index else None,
        use_sim_time=choices.use_sim_time,
        contract=None if choices.contract is None else Contract.read(choices.contract),
    )


def _pair(option: str, value_name: str, text: str) -> tuple[str, str]:
    pattern, sign, value = text.rpartition("=")
    if not sign or not pattern:
        raise UsageError(
            f"{option} takes a topic and a value ({option} TOPIC {value_name}), not "
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


def _name(choices: RecordChoices) -> str:
    if choices.replay is not None:
        return choices.replay.stem or "replay"
    return "ros1" if choices.is_ros1 else "ros2" if choices.ros2 else "foxglove"


def sources_of(choices: RecordChoices) -> list[LiveSource]:
    """The chosen sources; each imports the packages it needs.

    Raises:
        UsageError: A setting is malformed.
    """
    found: list[LiveSource] = []
    if choices.is_ros1:
        from hybridlog.live.sources.ros1.source import Ros1Source

        found.append(Ros1Source(choices.master))
    if choices.ros2:
        from hybridlog.live.sources.ros2.source import Ros2Source

        found.append(Ros2Source(qos_overrides=choices.qos))
    if choices.foxglove is not None:
        from hybridlog.live.sources.foxglove.source import FoxgloveSource

        found.append(FoxgloveSource(choices.foxglove))
    if choices.replay is not None:
        from hybridlog.live.sources.replay import ReplaySource

        found.append(ReplaySource(choices.replay, speed=choices.speed))
    return found
