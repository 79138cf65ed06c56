"""Records a running robot until a signal, and tells a service manager how it is doing."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from hybridlog.cli import output
from hybridlog.cli.live_table import LiveTable, summary
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.options import parse_tags
from hybridlog.cli.record_choices import (
    DEFAULT_CHUNK,
    OF_ENVIRONMENT,
    RecordChoices,
    matchers,
    opened_to_record,
    segment_settings,
)
from hybridlog.cli.record_summary import LiveSummary
from hybridlog.cli.signals import handled, restore_echo, write_note
from hybridlog_storage.errors import HybridlogError
from hybridlog_storage.settings import NONE
from hybridlog_storage.stopping import Flag

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from hybridlog.live.recorder import Recorder, RecorderOptions
    from hybridlog.live.sources.base import LiveSource
    from hybridlog.live.state import RecorderState
    from hybridlog.record.recorder import RecordReport
    from hybridlog.store import Store

_MIN_CHUNK: Final = 1 << 19
_STATE_S = 1.0
_RECOVERY_POLL_S = 0.05
_FOLLOWER_S: Final = 5.0
"""To wait for the follower where a service manager, or another recording, waits."""


class _Stop(Flag):
    """A flag that the first signal sets.

    Attributes:
        leave: Called at each; returns whether it ended the waiting for the follower.
    """

    number: int = signal.SIGINT
    leave: Callable[[], bool] = staticmethod(lambda: False)

    @property
    def wait_s(self) -> float | None:
        """Seconds to wait for the follower; a person can press Ctrl-C again instead."""
        return None if self.number == signal.SIGINT else _FOLLOWER_S


def record_live(choices: RecordChoices) -> None:
    """Record until a bound is reached, the replay has ended, or Ctrl-C."""
    try:
        _record(choices)
    except HybridlogError as error:
        if choices.as_json:  # the last line is a report in any case
            report = {"error": str(error), "exit_code": error.exit_code}
            output.print_json_line({"report": report})
        raise


def _record(choices: RecordChoices) -> None:
    from hybridlog.live.memory import frozen_objects
    from hybridlog.live.recorder import Recorder, make_room

    # Wrong options are found before a store is made.
    options = recorder_options(choices)
    sources = sources_of(choices)
    display = _Display(as_json=choices.as_json)
    reports: list[RecordReport] = []
    with ExitStack() as held:
        for source in sources:
            held.enter_context(source).check()
        store = held.enter_context(opened_to_record(choices, recover=False))
        make_room(store, options.reserve_bytes)
        recorders: list[Recorder] = []
        recovery = threading.Thread(target=_recover, args=(store, recorders), daemon=True)
        with _stop_flag() as stop, frozen_objects():
            full = ""
            while True:
                recorder = Recorder(store, sources, options, display.say)
                recorder.start()
                stop.leave = recorder.leave
                recorders.append(recorder)
                if full:
                    display.say(f"the manifest of {full} is full: {recorder.name} goes on")
                else:
                    recovery.start()
                with display.table(), _pinned_by_signal(recorder):
                    _watch(recorder, stop, display)
                if stop.is_set or not recorder.is_full:
                    break
                reports += recorder.stop(_FOLLOWER_S)
                options, full = recorder.rest, recorder.name
                sources = [held.enter_context(source) for source in sources_of(choices)]
            notify_service("STOPPING=1", "STATUS=writing what is left")
            output.remarks(["hybridlog: writing what is left; Ctrl-C leaves at once"])
            reports += recorder.stop(stop.wait_s, _tell_left)
            while recovery.is_alive() and not stop.wait(_RECOVERY_POLL_S):
                pass
        rules, results = options.contract, []
        if rules is not None:
            from hybridlog.contract.judge import broken  # loads pyarrow

            judged = [one for each in reports for one in store.judge(rules, each.entry.id)]
            results = broken(judged)
        ending = LiveSummary(reports, recorder, recorder.look(), sources, options, results)
        ending.print_and_exit(as_json=choices.as_json)


def recorder_options(choices: RecordChoices) -> RecorderOptions:
    """Options for the recorder from those of the command; patterns are checked."""
    from hybridlog.contract import Contract
    from hybridlog.follow.child import Trigger
    from hybridlog.live.memory import default_budget
    from hybridlog.live.policy import priority_rule, throttle_rule
    from hybridlog.live.recorder import RecorderOptions

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
        derives=not choices.no_derive,
        contract=None if choices.contract is None else Contract.read(choices.contract),
    )


def _name(choices: RecordChoices) -> str:
    if choices.replay is not None:
        return choices.replay.stem or "replay"
    return "ros1" if choices.ros1 is not None else "ros2" if choices.ros2 else "foxglove"


def sources_of(choices: RecordChoices) -> list[LiveSource]:
    """The chosen sources; each imports the packages it needs."""
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


def _recover(store: Store, recorders: Sequence[Recorder]) -> None:
    """Open the store again, which recovers what a crash has cut, beside the recorder.

    A process that ends meanwhile cuts nothing: the next command recovers it.
    """
    try:
        with opened_store(store.directory.path, NONE, quiet=True) as opened:
            recorders[-1].recovered()
            opened.catalog.has_changed = False  # the list of recordings is written at the end
    except (HybridlogError, OSError) as error:
        output.note(f"hybridlog: earlier recordings are not recovered yet: {error}")


def _tell_left(messages: int) -> None:
    if sys.stderr.isatty():
        left = output.counted(messages, "message")
        output.remarks([f"hybridlog: {left} left for tables and index; Ctrl-C leaves them"])


def _watch(recorder: Recorder, stop: Flag, display: _Display) -> None:
    display.state(recorder.look())
    while not (stop.is_set or recorder.wait(0)):
        stop.wait(_STATE_S)
        display.state(recorder.look())


@contextmanager
def _stop_flag() -> Iterator[_Stop]:
    """A flag that the first signal sets; the second signal ends the process at once.

    Flushed chunks stay, and the next command on the store seals them. While all is sealed and the
    follower is waited for, a signal leaves that.
    """
    with _Stop() as stopped:

        def stop(number: int) -> None:
            if not stopped.leave() and stopped.is_set:
                write_note(
                    "\nhybridlog: stopped. Flushed chunks stay; the next command seals them."
                )
                restore_echo()
                os._exit(128 + number)
            stopped.number = number
            stopped.set()

        with handled(stop):
            yield stopped


def _pinned_by_signal(recorder: Recorder) -> AbstractContextManager[object]:
    """SIGUSR1 marks and pins what is around it."""

    def fire(_: int) -> None:
        # Not in the handler: the code it interrupts may hold the locks.
        threading.Thread(target=recorder.fire, args=("SIGUSR1",), daemon=True).start()

    return handled(fire, [signal.SIGUSR1] if hasattr(signal, "SIGUSR1") else [])


class _Display:
    """Shows the progress: a table on a terminal, JSON for scripts."""

    def __init__(self, *, as_json: bool) -> None:
        self._as_json = as_json
        self._table: LiveTable | None = None
        if output.has_bars() and sys.stderr.isatty():
            self._table = LiveTable()

    def table(self) -> AbstractContextManager[object]:
        """The table, as a context manager."""
        return self._table or nullcontext()

    def say(self, text: str) -> None:
        """Print a message of the recorder at once."""
        from hybridlog.live.incidents import PINNED

        if output.is_quiet() and PINNED in text:  # no problem
            return
        if self._table is not None:
            self._table.note(text)
        else:
            output.note(f"hybridlog: {text}")

    def state(self, state: RecorderState) -> None:
        """Show the state, about once a second.

        The watchdog of a service hears of it while what is received is written, too.
        """
        told = ["READY=1", f"STATUS={output.printable(summary(state))}"]
        notify_service(*told, *(["WATCHDOG=1"] if state.stalled_s == 0 else ()))
        if self._table is not None:
            self._table.show(state)
        elif self._as_json:
            from hybridlog.live.state import summary_of

            with suppress(BrokenPipeError):  # who reads it may go; the recording goes on
                output.print_json_line({"state": summary_of(state)})


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
