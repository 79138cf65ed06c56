"""The clocks of log times: `/clock` of a simulation or played log, and that of this machine.

With `/clock` the log time of a message is the latest time of `/clock` at its arrival, as with
`use_sim_time` in ROS. It stands still while the clock is paused, and goes back with it.
Messages that come before the clock are held, so that latched ones are not missed, and get its
first time.

The clock of this machine may be set while a recorder runs. Log times are those of the clock,
whatever it says. Durations, such as that of a ring or of a
silence, are measured in steady times: log times without what the clock was set by.
"""

from __future__ import annotations

import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from hybridlog.record.losses import Cause
from hybridlog_storage.manifest import Loss, replace

if TYPE_CHECKING:
    from hybridlog.live.sources.base import Sink
    from hybridlog_storage.messages import Channel


CLOCK: Final = "/clock"
"""The topic with the time."""

_MAX_TICKS: Final = 4096  # past times, for messages and losses that are told late
_OVERHEAD: Final = 1024  # bytes of memory for a held message besides its payload
_MAX_NS: Final = 1 << 63
_ROS1 = struct.Struct("<II")
_CDR = {0: struct.Struct(">4xiI"), 1: struct.Struct("<4xiI")}


class SimulatedTime:
    """Passes messages on to a recorder, with the time of `/clock` as their receive time.

    It is a `Sink`; what is not about times is done by the recorder. Messages that come before the
    clock are held in `max_bytes`. `drop` counts one as received and lost: its channel, bytes of its
    payload, cause, a text for the user, time of the loss (ns).
    """

    def __init__(
        self,
        recorder: Sink,
        drop: Callable[[Channel, int, Cause, str, int], None],
        max_bytes: int,
    ) -> None:
        self._recorder = recorder
        self._drop = drop
        self._max_bytes = max_bytes
        self._is_clock_recorded = True
        self._lock = threading.Lock()
        self._latest = (0, 0)
        self._ticks: deque[tuple[int, int]] = deque(maxlen=_MAX_TICKS)
        # What is done when the clock comes, and when it does not.
        self._held: deque[tuple[Callable[[int], None], Callable[[], None]]] | None = deque()
        self._held_bytes = 0

    @property
    def is_waiting(self) -> bool:
        """True until the first time has come."""
        return not self._ticks

    @property
    def latest(self) -> int:
        """The latest time of the clock, ns; 0 before the first."""
        return self._latest[1]

    def clock(self, now: int, *, received: int) -> None:
        """Take a time of the clock, ns."""
        if not 0 <= now < _MAX_NS:
            self._recorder.say(f"{CLOCK}: {now} ns is no time that can be stored; it is ignored")
            return
        with self._lock:
            is_first, before = not self._ticks, self._latest[1]
            self._latest = (received, now)
            self._ticks.append(self._latest)
        if now < before:
            self._recorder.say(
                f"{CLOCK} went back by {(before - now) / 1e9:.3f} s, to {now / 1e9:.3f} s; log "
                "times go back with it"
            )
        if is_first:
            self._release(now)

    def at(self, received: int) -> int:
        """The latest time of the clock at a time of arrival, both in ns."""
        came, now = self._latest
        if received < came:
            with self._lock:
                earlier = (tick for tick in reversed(self._ticks) if tick[0] <= received)
                _, now = next(earlier, self._ticks[0])
        return now

    def close(self) -> None:
        """Count what is held as lost, if the clock never came."""
        with self._lock:
            held, self._held = self._held, None
        for _, drop in held or ():
            drop()

    # The sink.

    def wants(self, topic: str, type_name: str) -> bool:
        """See `Sink.wants`; the clock is needed even if it is not recorded."""
        wanted = self._recorder.wants(topic, type_name)
        if topic == CLOCK:
            self._is_clock_recorded = wanted
            return True
        return wanted

    def take(
        self,
        channel: Channel,
        payload: bytes,
        *,
        received: int,
        sent: int | None = None,
        sequence: int | None = None,
    ) -> None:
        """See `Sink.take`."""
        if channel.topic == CLOCK:
            now = clock_time(channel, payload)
            if now is None:
                self._recorder.say(
                    f"{CLOCK} has messages that are no rosgraph_msgs Clock of ROS 1 or ROS 2; they "
                    "give no time"
                )
            else:
                self.clock(now, received=received)
            if not self._is_clock_recorded:
                return

        def record(log_time: int) -> None:
            self._recorder.take(channel, payload, received=log_time, sent=sent, sequence=sequence)

        def drop() -> None:
            detail = f"it came before the first time of {CLOCK}"
            self._drop(channel, len(payload), Cause.CLOCK, detail, received)

        if self._held is None or not self._hold(len(payload), record, drop):
            record(self.at(received))

    def lost(self, loss: Loss) -> None:
        """See `Sink.lost`."""
        if loss.topic == CLOCK and not self._is_clock_recorded:
            return

        def report(first: int, last: int) -> None:
            self._recorder.lost(replace(loss, first=first, last=last))

        if self._held is None or not self._hold(
            0, lambda now: report(now, now), lambda: self._recorder.lost(loss)
        ):
            report(self.at(loss.first or 0), self.at(loss.last or 0))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._recorder, name)

    # Parts of it.

    def _hold(self, size: int, record: Callable[[int], None], drop: Callable[[], None]) -> bool:
        """Keep an item until the clock comes; False once everything held has been passed on."""
        with self._lock:
            if self._held is None:
                return False
            fits = self._held_bytes + size + _OVERHEAD <= self._max_bytes
            if fits:
                self._held_bytes += size + _OVERHEAD
                self._held.append((record, drop))
        if not fits:
            drop()
        return True

    def _release(self, now: int) -> None:
        """Pass on what is held, in the order of arrival."""
        while True:
            with self._lock:
                if not self._held:
                    self._held = None
                    return
                held, self._held, self._held_bytes = self._held, deque(), 0
            for record, _ in held:
                record(now)


def clock_time(channel: Channel, payload: bytes) -> int | None:
    """The time in a message of `/clock`, ns; None if it is no clock message."""
    name = channel.schema.name if channel.schema is not None else ""
    if channel.message_encoding == "ros1" and name == "rosgraph_msgs/Clock":
        form: struct.Struct | None = _ROS1
    elif channel.message_encoding == "cdr" and name == "rosgraph_msgs/msg/Clock":
        form = _CDR.get(payload[1]) if len(payload) > 1 else None
    else:
        form = None
    if form is None or len(payload) < form.size:
        return None
    seconds, nanoseconds = form.unpack_from(payload)
    return int(seconds) * 10**9 + int(nanoseconds)


_MIN_JUMP_NS: Final = 500_000_000  # a smaller difference is a clock that is slowed or sped up
_MAX_KEPT_JUMPS: Final = 1000


class Jump(NamedTuple):
    """The clock was set, at a steady time, forward or back; in all, this one included. All ns."""

    at: int
    by: int
    set_by: int


class MachineClock:
    """Notices when the clock is set: by `set_by` ns since the beginning. Thread safe.

    `now` returns its time, ns since the epoch, `monotonic` one that nobody sets, ns.
    """

    def __init__(
        self,
        now: Callable[[], int] = time.time_ns,
        monotonic: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.now = now
        self.set_by = 0
        self._monotonic = monotonic
        self._offset = now() - monotonic()
        self._jumps: deque[Jump] = deque(maxlen=_MAX_KEPT_JUMPS)
        self._told = now() - 1
        self._lock = threading.Lock()

    def steady(self, log_time: int) -> int:
        """A log time, ns, of about now, as if the clock had never been set."""
        if abs(log_time - self._monotonic() - self._offset) >= _MIN_JUMP_NS:
            self._look()
        return log_time - self.set_by

    def steady_before(self, log_time: int) -> int:
        """The last time at which the clock said a log time, as a steady time, ns."""
        now = self.steady(self.now())
        for jump in reversed(self._jumps):
            if jump.at <= log_time - jump.set_by <= now:
                return log_time - jump.set_by
        return log_time

    def log_time(self, steady: int) -> int:
        """The time of the clock at a steady time, ns."""
        return steady + next((j.set_by for j in reversed(self._jumps) if j.at <= steady), 0)

    def log_times(self, begin: int, end: int) -> tuple[int, int]:
        """The least and the greatest time of the clock between two steady times, ns."""
        found = [self.log_time(begin), self.log_time(end)]
        for jump in [*self._jumps]:
            if begin < jump.at <= end:
                found += [jump.at + jump.set_by - jump.by, jump.at + jump.set_by]
        return min(found), max(found)

    def jumps(self) -> list[Jump]:
        """The jumps since the last call."""
        self._look()
        with self._lock:
            found = [jump for jump in self._jumps if jump.at > self._told]
            self._told = max((jump.at for jump in found), default=self._told)
        return found

    def _look(self) -> None:
        with self._lock:
            now = self.now()
            by = now - self._monotonic() - self._offset
            self._offset += by
            if abs(by) >= _MIN_JUMP_NS:
                at = now - by - self.set_by
                self.set_by += by
                self._jumps.append(Jump(at, by, self.set_by))
