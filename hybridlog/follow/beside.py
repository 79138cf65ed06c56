"""The process beside a live recorder: evaluates triggers, then makes rows, tables and documents."""

from __future__ import annotations

import os
import signal
import time
from collections import Counter
from collections.abc import Callable, Collection
from contextlib import suppress
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Event, Lock, Thread
from typing import TYPE_CHECKING, Any, Final

from msgspec.structs import replace

import hybridlog
from hybridlog.entries import put_entry
from hybridlog.follow.child import Task, Trigger
from hybridlog.follow.follower import Follower, begin_again, make_rows_ahead
from hybridlog.maintenance.opening import missing
from hybridlog.maintenance.report import Followed
from hybridlog.query.answers.follow import Arrivals
from hybridlog.query.question import Counters, Question
from hybridlog.record.marks import MARKS
from hybridlog_storage.errors import (
    DatabaseError,
    DiskFullError,
    HybridlogError,
    StoreError,
    WithoutMongoError,
)

if TYPE_CHECKING:
    from hybridlog.store import Store

_EVERY_S: Final = 0.25
_ROWS_S: Final = 5.0
_NICE: Final = 5
_FIRST_TO_GO: Final = "500"
"""Added to its score where memory is short."""


def serve(handle: int) -> None:
    """Follow a recording to its end; ends with the recorder, too."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        # A service manager signals the recorder, too. MongoDB would inherit what is ignored.
        signal.signal(number, lambda *_: None)
    os.nice(_NICE)
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(_FIRST_TO_GO, "ascii")
    with Connection(handle) as control, suppress(EOFError, ConnectionError):
        task: Task = control.recv()
        if not task.triggers:  # it takes the time that nobody else wants
            with suppress(AttributeError, OSError):
                os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
        store = hybridlog.open(task.store, mongo=task.mongo)
        beside = _Beside(control, task, store)
        Thread(target=beside.hear, daemon=True).start()
        try:
            with store:
                beside.run()
        except HybridlogError as error:
            beside.tell("failed", str(error))
        else:
            beside.tell("done")


class _Beside:
    """Follows a recording, and tells its recorder."""

    def __init__(self, control: Connection[Any, Any], task: Task, store: Store) -> None:
        self._control = control
        self._task = task
        self._store = store
        self._triggers = [Trigger.of(text) for text in task.triggers]
        self._lock = Lock()
        self._ended = Event()
        self._follower: Follower | None = None
        self._state: Followed | None = None
        self._before = 0  # messages that an earlier process has indexed
        self._sealed: Collection[int] = ()  # that have their rows
        self._rows_due = 0.0

    def tell(self, *what: object) -> None:
        """Tell the recorder something."""
        with self._lock:
            self._control.send(what)

    def hear(self) -> None:
        """Hear the recorder, until it ends."""
        try:
            self._control.recv()  # that it is sealed
            self._ended.set()
            self._control.recv()  # until the recorder ends
        except (EOFError, OSError):
            os._exit(0)

    def run(self) -> None:
        """Do all that a recording needs until its end, and the rest then."""
        works = (self._derive, self._recover)
        threads = [Thread(target=self._harmless, args=(work,), daemon=True) for work in works]
        for thread in threads:
            thread.start()
        self._watch(self._task.seen)
        for thread in threads:
            while thread.is_alive():
                thread.join(_EVERY_S)
                self._tell_state()
        self._rows_due = 0.0
        self._make_rows(lambda: True)
        self._tell_state()

    def _tell_state(self) -> None:
        if self._follower is None:
            return
        state, before = self._follower.state, self._before
        state = state._replace(read=state.read + before, indexed=state.indexed + before)
        if state != self._state:
            self._state = state
            self.tell("state", state)

    # Triggers, and rows.

    def _watch(self, read: Any) -> None:
        """Evaluate triggers on what the recording has and gets, but for what was read before.

        Rows of what is sealed come next.
        """
        shared, recording = self._store.shared, self._task.recording
        session, counters = shared.now(), Counters()
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
        is_last = False
        while not is_last:
            is_last, started = self._ended.is_set(), time.monotonic()
            session = shared.now() if watched else session
            for trigger, one in zip(self._triggers, watched, strict=True):
                runs, _ = one.look(session)
                for run in runs:
                    self.tell("hit", trigger.text, run.batch.log_time.tolist())
            if counters.unreadable:
                counters.unreadable = 0
                self.tell("say", "triggers do not see messages that cannot be read, or lack arrays")
            if watched:
                now = dict(watched[0].read[recording]), frozenset(watched[0].sealed[recording])
                if now != read:
                    read = now
                    self.tell("read", read)
            self._make_rows(lambda: not self._ended.is_set())
            self._tell_state()
            if not is_last:
                self._ended.wait(max(_EVERY_S - (time.monotonic() - started), 0))

    def _make_rows(self, is_wanted: Callable[[], bool]) -> None:
        """Write rows of new sealed segments; now and then also of others, for rules may be new."""
        directory, recording, now = self._store.directory, self._task.recording, time.monotonic()
        sealed = directory.listing(recording).sealed
        if sealed != self._sealed or now >= self._rows_due:
            with suppress(StoreError, DiskFullError):  # the next look, or who lets them go
                make_rows_ahead(directory, recording, is_wanted)
                self._sealed, self._rows_due = sealed, now + _ROWS_S

    # The rest.

    def _harmless(self, work: Any) -> None:
        """Do something; the next command that writes makes what a failure has left."""
        try:
            work()
        except Exception as error:
            self.tell("say", f"tables and index are made later: {error or repr(error)}")

    def _derive(self) -> None:
        task, index = self._task, self._store.shared.index
        follower = self._begin(is_again=task.is_again)
        while not self._ended.wait(task.interval_s):
            with suppress(StoreError):  # the next look or the end sees it
                follower.follow()
            is_lost = follower.failure is not None and index.connected is None
            if is_lost and index.reached(brings=False) is not None:
                follower.discard()
                follower = self._begin(is_again=True)
        directory, catalog = self._store.directory, self._store.shared.catalog
        follower.finish(put_entry(directory, catalog, task.recording))

    def _begin(self, *, is_again: bool) -> Follower:
        """A new follower; one that begins again keeps the documents of whole segments."""
        store, task = self._store, self._task
        directory, catalog, index = store.directory, store.shared.catalog, store.shared.index
        target = index.index_to_record("Recording", brings=False)
        why = index.unavailable
        if why is not None and not isinstance(why, WithoutMongoError):
            self.tell("say", f"MongoDB is unavailable, {target.without}: {why}")
            if task.had_mongo and not target.is_wanted:
                target = replace(target, failure=DatabaseError(str(why)))
        entry = put_entry(directory, catalog, task.recording)
        done: Collection[str] = ()
        topics: Collection[str] | None = None
        if is_again:
            if target.database is not None:
                done, _ = begin_again(target.database, entry)
            manifest = directory.manifests.read(task.recording)
            logs = [log for number, log in manifest.logs.items() if str(number) in done]
            self._before = sum(part.messages for log in logs for part in log.parts.values())
            if manifest.is_ended:
                topics = missing(directory, entry)
        self._follower = Follower(directory, catalog, entry, target, topics=topics, done=done)
        return self._follower

    def _recover(self) -> None:
        """Seal what crashes have left of earlier recordings, and make their documents."""
        with hybridlog.open(self._task.store, mongo="none") as store:
            store.shared.recover()
            for name, segments in store.shared.repairs.recovered.items():
                kept = sum(one.messages for one in segments)
                self.tell("say", f"{name} was cut short by a crash: {kept} messages are recovered")
        self._store.shared.invalidate()
        self._store.shared.index.reached()  # which brings it up to date


def _takes(trigger: Trigger, topic: str) -> bool:
    return topic != MARKS and trigger.fits(topic)  # which it makes itself
