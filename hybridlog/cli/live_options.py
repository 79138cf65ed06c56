"""Options of the live recorder, and its sources, from the parameters of `hybridlog record`."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from hybridlog.cli.options import parse_tags
from hybridlog.cli.record_choices import (
    DEFAULT_CHUNK,
    OF_ENVIRONMENT,
    RecordChoices,
    matchers,
    segment_settings,
)

if TYPE_CHECKING:
    from hybridlog.live.recorder import RecorderOptions
    from hybridlog.live.sources.base import LiveSource

_MIN_CHUNK: Final = 1 << 19


def recorder_options(choices: RecordChoices) -> RecorderOptions:
    """Options of the recorder.

    Raises:
        UsageError: A value is out of range.
        TopicError: A pattern that is malformed.
    """
    from hybridlog.contract import Contract
    from hybridlog.live.memory import default_budget
    from hybridlog.live.policy import priority_rule, throttle_rule
    from hybridlog.live.recorder import RecorderOptions
    from hybridlog.live.triggers import Trigger

    chosen, no_index = matchers(choices)
    budget_bytes = choices.budget or default_budget()
    # Each topic of large messages has an open chunk, and all of them are to fit.
    chunk_size = min(max(budget_bytes >> 8, _MIN_CHUNK), DEFAULT_CHUNK)
    settings = replace(
        segment_settings(choices, chunk_size),
        segment_size=choices.split_size,
        segment_span_s=choices.split_duration,
    )
    return RecorderOptions(
        name=choices.name or _name(choices),
        tags=parse_tags(choices.set_tag),
        matcher=chosen,
        throttles=[throttle_rule(*one) for one in choices.throttle],
        priorities=[priority_rule(*one) for one in choices.priority],
        duration_s=choices.duration,
        max_messages=choices.max_messages,
        max_bytes=choices.max_size,
        reserve_bytes=choices.reserve,
        budget_bytes=budget_bytes,
        flush_interval_s=choices.flush_interval,
        settings=settings,
        ring_s=choices.ring,
        triggers=[Trigger.of(text) for text in choices.trigger],
        before_s=choices.before,
        after_s=choices.after or 0.0,
        no_index=no_index,
        use_sim_time=choices.use_sim_time,
        contract=None if choices.contract is None else Contract.read(choices.contract),
    )


def _name(choices: RecordChoices) -> str:
    if choices.replay is not None:
        return choices.replay.stem or "replay"
    return "ros1" if choices.ros1 is not None else "ros2" if choices.ros2 else "foxglove"


def sources_of(choices: RecordChoices) -> list[LiveSource]:
    """The chosen sources; each imports the packages it needs.

    Raises:
        UsageError: A setting is malformed.
    """
    found: list[LiveSource] = []
    if choices.ros1 is not None:
        from hybridlog.live.sources.ros1.source import Ros1Source

        found.append(Ros1Source(None if choices.ros1 == OF_ENVIRONMENT else choices.ros1))
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
