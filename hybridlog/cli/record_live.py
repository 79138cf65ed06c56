"""`hybridlog record` of a running robot."""

from __future__ import annotations

import json
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from types import FrameType
from typing import TYPE_CHECKING

from hybridlog.cli import output
from hybridlog.cli.live_choices import LiveChoices, sources_of
from hybridlog.cli.live_closing import Closing
from hybridlog.cli.live_table import LiveTable, in_short
from hybridlog.cli.opening import opened
from hybridlog.cli.stopping import SIGNALS

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from hybridlog.cli.record import Choices
    from hybridlog.live.recorder import Recorder, RecorderOptions, RecorderState

_LOOK_S = 1.0
_PATIENCE_S = 2.0  # of closing; what takes longer is explained
_NEWS = re.compile(r"snapshot \S+ because of ")
"""What a recorder says that is no trouble: `--quiet` does without it."""


def run(live: LiveChoices, options: Callable[[], RecorderOptions], choices: Choices) -> None:
    """Record until a bound is reached, everything has been played, or Ctrl-C."""
    from hybridlog.live.recorder import Recorder

    # Everything that can be wrong with the options is wrong before a store is made.
    chosen = options()
    sources = sources_of(live)
    quiet = choices.quiet
    shown = _Shown(as_json=choices.as_json, quiet=quiet)
    with ExitStack() as held:
        for source in sources:
            held.enter_context(source).check()
        store = held.enter_context(
            opened(
                choices.store,
                choices.mongo,
                create=True,
                shared=choices.shared,
                needs_database=True,
                quiet=quiet,
            )
        )
        with _until_told() as told_to_stop:
            recorder = Recorder(store, sources, chosen, shown.say)
            recorder.start()
            with shown.table(), _fired_by_signal(recorder, chosen):
                last = _watch(recorder, told_to_stop, shown)
            if quiet:
                reports = recorder.stop()
            else:
                output.note("hybridlog: writing what is left; Ctrl-C leaves at once")
                with _explained(last):
                    reports = recorder.stop()
        Closing(reports, recorder, sources, chosen).tell(as_json=choices.as_json, quiet=quiet)


def _watch(recorder: Recorder, told_to_stop: threading.Event, shown: _Shown) -> RecorderState:
    state = recorder.look()
    shown.state(state)
    while not told_to_stop.is_set() and not recorder.wait(0):
        told_to_stop.wait(_LOOK_S)
        state = recorder.look()
        shown.state(state)
    return state


@contextmanager
def _explained(last: RecorderState) -> Iterator[None]:
    """Say what closing waits for, when it takes long."""
    what = "what is left is still being written"
    if last.lag:
        what = f"waiting for MongoDB, which lacks {output.counted(last.lag, 'message')}"
    if last.index_failure:
        what += f" ({in_short(last.index_failure)})"
    timer = threading.Timer(_PATIENCE_S, output.note, [f"hybridlog: {what}"])
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


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
    """What the person, or the script, sees while it goes on."""

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
        if self._quiet and _NEWS.match(text):
            return
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
