"""`hybridlog record` of a running robot."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import typer

from hybridlog.cli import output
from hybridlog.cli.live_table import LiveTable, closing_rows
from hybridlog.cli.opening import opened
from hybridlog.cli.stopping import SIGNALS
from hybridlog_storage.errors import DatabaseError, DiskFullError, UsageError

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from hybridlog.cli.record import Choices
    from hybridlog.live.recorder import Recorder, RecorderOptions, RecorderState
    from hybridlog.live.snapshots import SnapshotOptions
    from hybridlog.live_sources.base import LiveSource
    from hybridlog.recorder import RecordReport
    from hybridlog_storage.segment_writer import SegmentSettings

_LOOK_S = 1.0


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
    budget: str = "512MB"
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


def run(live: LiveChoices, options: Callable[[], RecorderOptions], choices: Choices) -> None:
    """Record until a bound is reached, everything has been played, or Ctrl-C."""
    from hybridlog.live.recorder import Recorder

    # Everything that can be wrong with the options is wrong before a store is made.
    chosen = options()
    sources = _sources(live)
    quiet = choices.quiet
    shown = _Shown(as_json=choices.as_json, quiet=quiet)
    with ExitStack() as held:
        for source in sources:
            held.enter_context(source).check()
        store = held.enter_context(
            opened(choices.store, choices.mongo, create=True, needs_database=True, quiet=quiet)
        )
        with _until_told() as told_to_stop:
            recorder = Recorder(store, sources, chosen, shown.say)
            recorder.start()
            with shown.table(), _fired_by_signal(recorder, chosen):
                _watch(recorder, told_to_stop, shown)
            if not quiet:
                output.note("hybridlog: writing what is left; Ctrl-C leaves at once")
            reports = recorder.stop()
        shown.close(reports, recorder, chosen)


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
    from dataclasses import replace

    from hybridlog.live.policy import priority_rule, throttle_rule
    from hybridlog.live.recorder import RecorderOptions
    from hybridlog.query.topics import matcher

    if live.split_size is not None:
        settings = replace(settings, segment_size=output.parse_size(live.split_size))
    if live.split_duration is not None:
        settings = replace(settings, segment_span_s=_seconds(live.split_duration))
    return RecorderOptions(
        name=name or _name(live),
        tags=tags,
        matcher=matcher(topics, exclude) if topics or exclude else None,
        throttles=[throttle_rule(*_pair("--throttle", t)) for t in live.throttle or ()],
        priorities=[priority_rule(*_pair("--priority", t)) for t in live.priority or ()],
        duration_s=None if live.duration is None else _seconds(live.duration),
        max_messages=live.max_messages,
        max_bytes=None if live.max_size is None else output.parse_size(live.max_size),
        reserve_bytes=output.parse_size(live.reserve),
        budget_bytes=output.parse_size(live.budget),
        flush_interval_s=_seconds(live.flush_interval),
        settings=settings,
        snapshots=_snapshots(live),
    )


def _snapshots(live: LiveChoices) -> SnapshotOptions | None:
    from hybridlog.live.snapshots import SnapshotOptions, Trigger

    if live.ring is None:
        if live.trigger or live.before is not None or live.after is not None:
            raise UsageError("--trigger, --before and --after are for --ring.")
        return None
    return SnapshotOptions(
        _seconds(live.ring),
        None if live.before is None else _seconds(live.before),
        0.0 if live.after is None else _seconds(live.after),
        tuple(Trigger.of(text) for text in live.trigger or ()),
    )


def _pair(option: str, text: str) -> tuple[str, str]:
    pattern, sign, value = text.rpartition("=")
    if not sign or not pattern:
        raise UsageError(f"{option} wants a topic and a value, not {text!r}.")
    return pattern, value


def _seconds(text: str) -> float:
    from hybridlog.query.times import parse_duration

    return parse_duration(text) / 1e9


def _name(live: LiveChoices) -> str:
    if live.replay is not None:
        return live.replay.stem or "replay"
    return "ros1" if live.ros1 else "ros2" if live.ros2 else "foxglove"


def _sources(live: LiveChoices) -> list[LiveSource]:
    """Those that were asked for; each loads what it needs."""
    found: list[LiveSource] = []
    if live.ros1:
        from hybridlog.live_sources.ros1 import Ros1Source

        found.append(Ros1Source(live.master))
    if live.ros2:
        from hybridlog.live_sources.ros2 import Ros2Source

        found.append(Ros2Source(qos_overrides=live.qos))
    if live.foxglove is not None:
        from hybridlog.live_sources.foxglove import FoxgloveSource

        found.append(FoxgloveSource(live.foxglove))
    if live.replay is not None:
        from hybridlog.live_sources.replay import ReplaySource

        found.append(ReplaySource(live.replay, speed=live.speed))
    return found


def _watch(recorder: Recorder, told_to_stop: threading.Event, shown: _Shown) -> None:
    shown.state(recorder.look())
    while not told_to_stop.is_set() and not recorder.wait(0):
        told_to_stop.wait(_LOOK_S)
        shown.state(recorder.look())


@contextmanager
def _until_told() -> Iterator[threading.Event]:
    """Set the event at the first signal; at the second one, leave at once.

    What was flushed by then stays, and the next command on the store seals it.
    """
    told = threading.Event()

    def stop(number: int, _frame: FrameType | None) -> None:
        if told.is_set():
            text = "\nhybridlog: left. What was flushed stays; the next command seals it.\n"
            os.write(2, text.encode())
            os._exit(128 + number)
        told.set()

    before = {number: signal.getsignal(number) for number in SIGNALS}
    for number, handler in before.items():
        if handler is not signal.SIG_IGN:
            signal.signal(number, stop)
    try:
        yield told
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _fired_by_signal(recorder: Recorder, options: RecorderOptions) -> Iterator[None]:
    """SIGUSR1 writes a snapshot."""
    if options.snapshots is None or not hasattr(signal, "SIGUSR1"):
        yield
        return

    def fire(number: int, _frame: FrameType | None) -> None:
        # Not in the handler: what it interrupts may hold the locks that are needed.
        threading.Thread(target=recorder.fire, args=("SIGUSR1",), daemon=True).start()

    before = signal.signal(signal.SIGUSR1, fire)
    try:
        yield
    finally:
        signal.signal(signal.SIGUSR1, before)


class _Shown:
    """What the person, or the script, sees."""

    def __init__(self, *, as_json: bool, quiet: bool) -> None:
        self._as_json = as_json
        self._quiet = quiet
        self._table: LiveTable | None = None
        if not as_json and not quiet and sys.stderr.isatty():
            self._table = LiveTable()

    def table(self) -> AbstractContextManager[object]:
        """Shown while recording."""
        return self._table or nullcontext()

    def say(self, text: str) -> None:
        """Tell something at once."""
        if self._table is not None:
            self._table.note(text)
        else:
            output.note(f"hybridlog: {text}")

    def state(self, state: RecorderState) -> None:
        """How it goes, about once a second."""
        if self._table is not None:
            self._table.show(state)
        elif self._as_json:
            from hybridlog.live.recorder import summary_of

            print(json.dumps({"state": summary_of(state)}), flush=True)  # noqa: T201

    def close(
        self, reports: Sequence[RecordReport], recorder: Recorder, options: RecorderOptions
    ) -> None:
        """How it went; leaves with the code of what went wrong."""
        state, reason = recorder.look(), recorder.reason
        if self._as_json:
            summary = _summary(reports, state, reason)
            print(json.dumps({"report": summary}), flush=True)  # noqa: T201
        elif not self._quiet:
            _print(reports, state, reason)
        if not self._quiet:
            for topic in recorder.silent():
                output.note(f"{topic}: has a publisher, and never said anything")
            for pattern in options.matcher.unused() if options.matcher is not None else ():
                output.note(f"no topic fits {pattern!r}")
        for report in reports:
            if report.failure is not None:
                output.note(
                    f"hybridlog: {report.failure} {output.stored(report.missed)} but not in the "
                    "index; the next command that opens the store catches up."
                )
                raise typer.Exit(DatabaseError.exit_code)
        if state.lost.get("disk"):
            raise typer.Exit(DiskFullError.exit_code)


def _print(reports: Sequence[RecordReport], state: RecorderState, reason: str) -> None:
    if state.snapshots is None:
        rows = closing_rows(reports[0], state)
        if reason:
            rows.append(("ended", reason))
        output.print_table([("recording", "left"), (reports[0].entry.id, "left")], rows)
        return
    if not reports:
        output.note("Nothing was triggered, so nothing is kept.")
        return
    output.print_table(
        [("snapshot", "left"), ("because of", "left"), ("messages", "right"), ("stored", "right")],
        [
            (
                report.entry.id,
                report.entry.tags.get("trigger", ""),
                str(report.entry.messages),
                output.size(report.entry.stored_bytes),
            )
            for report in reports
        ],
    )


def _summary(reports: Sequence[RecordReport], state: RecorderState, reason: str) -> dict[str, Any]:
    recordings = [
        {
            "recording": report.entry.id,
            "status": report.entry.status,
            "tags": report.entry.tags,
            "messages": report.entry.messages,
            "messages_indexed": report.indexed,
            "losses": report.entry.end.get("losses", []),
            "bytes_stored": report.entry.stored_bytes,
            "seconds": round(report.elapsed_s, 3),
        }
        for report in reports
    ]
    return {
        "ended": reason,
        "recordings": recordings,
        "messages_received": state.messages,
        "bytes": state.stored_bytes,
        "lost": dict(state.lost),
        "topics": {
            topic.topic: {"received": topic.messages, "lost": topic.lost} for topic in state.topics
        },
    }


def refuse_with_logs(live: LiveChoices, paths: Sequence[Path]) -> None:
    """A log and a robot at once make no recording.

    Raises:
        UsageError: Both, or neither, were given.
    """
    if paths and live.any_source:
        raise UsageError("Give either logs to record or a robot (--ros1, --ros2, …), not both.")
    if not paths and not live.any_source:
        raise UsageError(
            "Nothing to record: give a log, or --ros1, --ros2, --foxglove URL or --replay FILE."
        )
