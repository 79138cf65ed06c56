"""The process beside a recorder: evaluates triggers on the columns of new chunks."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import hybridlog
from hybridlog.follow.triggers import Trigger
from hybridlog.query.answers.follow import Arrivals
from hybridlog.query.counters import Counters
from hybridlog.query.predicate.types import check
from hybridlog.query.question import Question
from hybridlog.record.marks import MARKS
from hybridlog.schema.codecs import codec_for
from hybridlog_storage.errors import DefinitionError, HybridlogError, WhereError

if TYPE_CHECKING:
    from hybridlog_storage.messages import Channel

_EVERY_S: Final = 0.25
_NICE: Final = 5
_FIRST_TO_GO: Final = "500"
"""Added to its score where memory is short."""


def serve(handle: int) -> None:
    """Follow a recording to its end; ends with the recorder, too."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # a service manager signals the recorder, too
    os.nice(_NICE)
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(_FIRST_TO_GO, "ascii")
    with Connection(handle) as control, suppress(EOFError, ConnectionError):
        address, recording, texts, read = control.recv()
        watch = _Watch(control, [Trigger.of(text) for text in texts])
        threading.Thread(target=watch.hear, daemon=True).start()
        try:
            watch.run(address, recording, read)
        except HybridlogError as error:
            watch.tell("failed", str(error))
        else:
            watch.tell("done")


class _Watch:
    """Evaluates triggers, and tells a recorder."""

    def __init__(self, control: Connection[Any, Any], triggers: Sequence[Trigger]) -> None:
        self._control = control
        self._triggers = triggers
        self._lock = threading.Lock()

    def tell(self, *what: object) -> None:
        """Tell the recorder something."""
        with self._lock:
            self._control.send(what)

    def hear(self) -> None:
        """Check the triggers on the channels that the recorder expects, until it ends."""
        try:
            while True:
                self._check(self._control.recv())
        except (EOFError, OSError):
            os._exit(0)

    def _check(self, channel: Channel) -> None:
        with suppress(DefinitionError):
            types = {path.path: path.type for path in codec_for(channel).paths()} or None
            for one in self._triggers:
                if one.predicate is not None and one.fits(channel.topic):
                    try:
                        check(one.predicate, types)
                    except WhereError as error:
                        never = f"trigger {one.text!r} can never fire on {channel.topic}"
                        self.tell("say", f"{never}: {error}")

    def run(self, address: str, recording: str, read: Any) -> None:
        """Evaluate what a recording has and gets, until it ends, but for what was read before."""
        store = hybridlog.open(address, mongo="none", read_only=True)
        session, counters = store.shared.now(), Counters()
        watched = [
            Arrivals(
                session,
                Question((), (recording,), predicate=one.predicate),
                counters,
                partial(_takes, one),
            )
            for one in self._triggers
        ]
        for one in watched if read is not None else ():
            one.read[recording], one.sealed[recording] = Counter(read[0]), set(read[1])
        goes_on = True
        while goes_on:
            started = time.monotonic()
            session = store.shared.now().again()
            for trigger, one in zip(self._triggers, watched, strict=True):
                runs, goes_on = one.look(session)
                for run in runs:
                    self.tell("hit", trigger.text, run.batch.log_time.tolist())
            if counters.unreadable:
                counters.unreadable = 0
                self.tell("say", "triggers do not see messages that cannot be read, or lack arrays")
            now = dict(watched[0].read[recording]), frozenset(watched[0].sealed[recording])
            if now != read:
                read = now
                self.tell("read", read)
            if goes_on:
                time.sleep(max(_EVERY_S - (time.monotonic() - started), 0))


def _takes(trigger: Trigger, topic: str) -> bool:
    return topic != MARKS and trigger.fits(topic)  # which it makes itself
