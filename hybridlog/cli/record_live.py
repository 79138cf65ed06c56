"""Records a running robot until a signal, and tells a service manager how it is doing."""

from __future__ import annotations

import gc
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from functools import partial
from typing import TYPE_CHECKING, Final

from msgspec.structs import asdict, replace

from hybridlog.cli import output
from hybridlog.cli.app import DIFFERENT
from hybridlog.cli.commands.top import draw, summary
from hybridlog.cli.options import parse_tags
from hybridlog.cli.record_choices import (
    ENVIRONMENT_MASTER,
    RecordChoices,
    line_of,
    not_indexed,
    remarks_on,
    row_of,
)
from hybridlog.cli.signals import handled, write_note
from hybridlog.contract import Contract
from hybridlog.follow.child import Trigger
from hybridlog.live.incidents import PINNED
from hybridlog.live.recorder import Recorder, RecorderOptions, priority_rule, throttle_rule
from hybridlog.live.recording import default_budget
from hybridlog.query.answers.completeness import coverage, in_words
from hybridlog.record.losses import Cause, losses_of
from hybridlog_storage.errors import (
    DatabaseError,
    DiskFullError,
    HybridlogError,
    SourceDamagedError,
    SourceError,
)
from hybridlog_storage.stopping import Flag

if TYPE_CHECKING:
    from hybridlog.contract.judge import Result
    from hybridlog.live.sources.base import LiveSource
    from hybridlog.live.state import RecorderState
    from hybridlog.record.recorder import RecordReport

_CHUNKS: Final = 1 << 19, 2 << 20
"""Least and usual bytes of a chunk."""
_STATE_S = 1.0
_FOLLOWER_S: Final = 5.0
"""To wait for the follower where a service manager, or another recording, waits."""


class _Stop(Flag):
    """A flag that the first signal sets.

    Attributes:
        leave: Called at each; returns whether it ended the waiting for the follower.
        wait_s: Seconds to wait for the follower; a person can press Ctrl-C again instead.
    """

    leave: Callable[[], bool] = staticmethod(lambda: False)
    wait_s: float | None = None


def record_live(choices: RecordChoices) -> int:
    """Record until a bound is reached, the replay has ended, or Ctrl-C; returns the exit code."""
    try:
        return _record(choices)
    except HybridlogError as error:
        if choices.as_json:  # the last line is a report in any case
            report = {"error": str(error), "exit_code": error.exit_code}
            output.print_json({"report": report}, at_once=True)
        raise


def _record(choices: RecordChoices) -> int:
    # Wrong options are found before a store is made.
    options = recorder_options(choices)
    sources = sources_of(choices)
    table = output.Drawn() if output.has_bars() else None
    show = partial(_show, table=table, as_json=choices.as_json)
    reports: list[RecordReport] = []
    with ExitStack() as held:
        for source in sources:
            held.enter_context(source).check()
        store = held.enter_context(choices.opened(create=True))
        gc.freeze()  # the collector skips what was there before
        with _stop_flag() as stop:
            while True:
                recorder = Recorder(store, sources, options, _say)
                recorder.start()
                stop.leave = recorder.leave
                if reports:
                    full = reports[-1].entry.name
                    _say(f"the manifest of {full} is full: {recorder.name} goes on")
                with table or nullcontext(), _pinned_by_signal(recorder):
                    show(recorder.look())
                    while not (stop.is_set or recorder.wait(0)):
                        stop.wait(_STATE_S)
                        show(recorder.look())
                if stop.is_set or not recorder.is_full:
                    break
                reports += recorder.stop(_FOLLOWER_S)
                options = recorder.rest
                sources = [held.enter_context(source) for source in sources_of(choices)]
            notify_service("STOPPING=1", "STATUS=writing what is left")
            output.remarks(["hybridlog: writing what is left; Ctrl-C leaves at once"])
            reports += recorder.stop(stop.wait_s)
        broken: list[Result] = []
        if options.contract is not None:
            from hybridlog.contract import judge  # loads pyarrow

            for one in reports:
                broken += judge.broken(store.judge(options.contract, one.entry.id))
        return _finish(choices, reports, recorder, sources, broken)


def _finish(
    choices: RecordChoices,
    reports: Sequence[RecordReport],
    recorder: Recorder,
    sources: Sequence[LiveSource],
    broken: Sequence[Result],
) -> int:
    """Print what was recorded; returns the exit code of the worst problem."""
    state, reason = recorder.look(), recorder.reason
    unreached = [one.address for one in sources if not one.was_reached]
    failed = [one for one in reports if one.failure is not None]
    worst = {
        DiskFullError.exit_code: recorder.stopped_for_disk or Cause.DISK in state.lost,
        DatabaseError.exit_code: failed,
        SourceError.exit_code: len(unreached) == len(sources) and not state.messages,
        SourceDamagedError.exit_code: Cause.UNREADABLE in state.lost,
        DIFFERENT: broken,
    }
    code = next((code for code, applies in worst.items() if applies), 0)
    rows = [row_of(one, one.entry.manifest.source.path) for one in reports]
    if choices.as_json:
        about = {
            "ended": reason,
            "recordings": rows,
            "messages_received": state.messages,
            "bytes": state.stored_bytes,
            # A cause without a number stands for an unknown number.
            "lost": {cause: count or None for cause, count in state.lost.items()},
            "topics": {
                one.topic: {"received": one.messages, "lost": one.lost} for one in state.topics
            },
            "broken": [asdict(one) for one in broken],
            "exit_code": code,
        }
        output.print_json({"report": about}, at_once=True)
    else:
        told = [f"{state.messages} received", reason]
        if rows:
            entry = reports[-1].entry
            let_go = [f"{state.let_go} let go by the ring"] if state.let_go else []
            told[1:1] = [coverage(entry, losses_of(entry)), *let_go]
        output.tell(None, [*map(line_of, rows or ()), "; ".join(told)])
    output.remarks(f"{topic}: has a publisher that sent nothing" for topic in recorder.silent())
    output.remarks(f"no topic fits {text}" for text in recorder.unfitting())
    for report in reports:
        output.remarks(remarks_on(report))
    errors = [
        f"{one.topic or 'the recording'} breaks {one.rule} {one.wanted}: {one.found}"
        for one in broken
    ]
    errors += (f"{one} was never reached, so nothing of it is recorded." for one in unreached)
    if recorder.stopped_for_disk and (choices.as_json or output.is_quiet()):
        errors.append(reason)
    losses = [row for one in reports for row in one.entry.losses]
    if lost := [row for row in losses if row["cause"] == Cause.UNREADABLE]:
        errors.append(f"{in_words(lost)} that cannot be read; `hybridlog info --losses` lists them")
    output.notes(f"hybridlog: {line}" for line in (*errors, *map(not_indexed, failed)))
    return code


def recorder_options(choices: RecordChoices) -> RecorderOptions:
    """Options for the recorder from those of the command; patterns are checked."""
    chosen, no_index = choices.matchers()
    budget_bytes = choices.budget or default_budget()
    # Each topic of large messages has an open chunk, and all of them are to fit.
    least, usual = _CHUNKS
    settings = replace(
        choices.segment_settings(min(max(budget_bytes >> 8, least), usual)),
        segment_size=choices.split_size,
        segment_span_s=choices.split_duration,
    )
    name = "ros1" if choices.ros1 is not None else "ros2" if choices.ros2 else "foxglove"
    if choices.replay is not None:
        name = choices.replay.stem or "replay"
    return RecorderOptions(
        name=choices.name or name,
        tags=parse_tags(choices.set_tag),
        matcher=chosen,
        throttles=[throttle_rule(*one) for one in choices.throttle],
        priorities=[priority_rule(*one) for one in choices.priority],
        duration_s=choices.duration,
        max_messages=choices.max_messages,
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
        derives=not choices.no_derive,
        contract=None if choices.contract is None else Contract.read(choices.contract),
    )


def sources_of(choices: RecordChoices) -> list[LiveSource]:
    """The chosen sources; each imports the packages it needs."""
    found: list[LiveSource] = []
    if choices.ros1 is not None:
        from hybridlog.live.sources.ros1.source import Ros1Source

        found.append(Ros1Source(None if choices.ros1 == ENVIRONMENT_MASTER else choices.ros1))
    if choices.ros2:
        from hybridlog.live.sources.ros2.source import Ros2Source

        found.append(Ros2Source())
    if choices.foxglove is not None:
        from hybridlog.live.sources.foxglove.source import FoxgloveSource

        found.append(FoxgloveSource(choices.foxglove))
    if choices.replay is not None:
        from hybridlog.live.sources.replay import ReplaySource

        found.append(ReplaySource(choices.replay, speed=choices.speed))
    return found


@contextmanager
def _stop_flag() -> Iterator[_Stop]:
    """A flag that the first signal sets; the second signal ends the process at once.

    Flushed chunks stay, and the next command on the store seals them. While all is sealed and the
    follower is waited for, a signal leaves that.
    """
    stopped = _Stop()

    def stop(number: int) -> None:
        if not stopped.leave() and stopped.is_set:
            write_note("\nhybridlog: stopped. Flushed chunks stay; the next command seals them.")
            os._exit(128 + number)
        stopped.wait_s = None if number == signal.SIGINT else _FOLLOWER_S
        stopped.set()

    with handled(stop):
        yield stopped


@contextmanager
def _pinned_by_signal(recorder: Recorder) -> Iterator[None]:
    """SIGUSR1 marks and pins what is around it."""

    def fire(_: int) -> None:
        # Not in the handler: the code it interrupts may hold the locks.
        threading.Thread(target=recorder.fire, args=("SIGUSR1",), daemon=True).start()

    with handled(fire, [signal.SIGUSR1] if hasattr(signal, "SIGUSR1") else []):
        yield


def _say(text: str) -> None:
    """Print a message of the recorder at once."""
    if not (output.is_quiet() and PINNED in text):  # which is no problem
        output.note(f"hybridlog: {text}")


def _show(state: RecorderState, table: output.Drawn | None, *, as_json: bool) -> None:
    """Show the state, about once a second: in a table on a terminal, as JSON for scripts.

    The watchdog of a service hears of it while what is received is written, too.
    """
    told = ["READY=1", f"STATUS={output.printable(summary(state))}"]
    notify_service(*told, *(["WATCHDOG=1"] if state.stalled_s == 0 else ()))
    if table is not None:
        draw(state, table)
    elif as_json:
        with suppress(BrokenPipeError):  # who reads it may go; the recording goes on
            output.print_json({"state": asdict(state)}, at_once=True)


def notify_service(*assignments: str) -> None:
    """Send assignments such as `READY=1` to the service manager; does nothing without one."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if address[:1] not in {"/", "@"}:
        return
    # It is a help, and must not stop a recording.
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as connection:
        connection.setblocking(False)
        place = f"\0{address[1:]}" if address[0] == "@" else address
        connection.sendto("\n".join(assignments).encode("utf-8", "replace"), place)
