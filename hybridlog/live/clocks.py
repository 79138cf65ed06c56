"""The clocks of log times: `/clock` of a simulation or played log, and that of this machine.

With `/clock` the log time of a message is the latest time of `/clock` at its arrival, as with
`use_sim_time` in ROS. It stands still while the clock is paused, and goes back with it.
Messages that come before the clock are held, so that latched ones are not missed, and get its
first time.

The clock of this machine may be set while a recorder runs. Log times are those of the clock,
whatever it says. Durations, such as that of a ring or of a silence, are measured in times that
nobody sets.
"""

from __future__ import annotations

import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

from hybridlog.record.losses import Cause
from hybridlog_storage.manifest import Loss, replace

if TYPE_CHECKING:
    from hybridlog.live.sources.base import Sink
    from hybridlog_storage.messages import Channel

    _Record = Callable[[Callable[[int], int]], None]


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
    clock are held in `max_bytes`.
    """

    def __init__(self, recorder: Sink, max_bytes: int) -> None:
        self._recorder = recorder
        self._max_bytes = max_bytes
        self._lock = threading.Lock()
        self._latest = (0, 0)
        self._ticks: deque[tuple[int, int]] = deque(maxlen=_MAX_TICKS)
        # What is done when the clock comes, and what is lost when it does not.
        self._held: list[tuple[_Record, Loss]] | None = []
        self._held_bytes = 0

    @property
    def is_waiting(self) -> bool:
        """True until the first time has come."""
        return not self._ticks

    @property
    def latest(self) -> int:
        """The latest time of the clock, ns; 0 before the first."""
        return self._latest[1]

    def _tick(self, now: int, received: int) -> None:
        """Take a time of the clock, ns."""
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
        for _, loss in held or ():
            self._recorder.lost(loss)

    # The sink.

    def wants(self, topic: str, type_name: str) -> bool:
        """See `Sink.wants`; the clock is recorded in any case."""
        return topic == CLOCK or self._recorder.wants(topic, type_name)

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
                    f"{CLOCK} has messages that are no rosgraph_msgs Clock of ROS 1 or ROS 2, or "
                    "whose time cannot be stored; they give no time"
                )
            else:
                self._tick(now, received)

        def record(at: Callable[[int], int]) -> None:
            self._recorder.take(
                channel, payload, received=at(received), sent=sent, sequence=sequence
            )

        detail = f"it came before the first time of {CLOCK}"
        loss = Loss(Cause.CLOCK, channel.topic, 1, received, received, detail)
        self._pass(len(payload), record, loss)

    def lost(self, loss: Loss) -> None:
        """See `Sink.lost`."""

        def record(at: Callable[[int], int]) -> None:
            self._recorder.lost(replace(loss, first=at(loss.first or 0), last=at(loss.last or 0)))

        self._pass(0, record, loss)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._recorder, name)

    def _pass(self, size: int, record: _Record, loss: Loss) -> None:
        """Pass something on with the time of the clock, or hold it until there is one."""
        with self._lock:
            is_held, size = self._held is not None, size + _OVERHEAD
            fits = self._held_bytes + size <= self._max_bytes
            if self._held is not None and fits:
                self._held_bytes += size
                self._held.append((record, loss))
        if not is_held:
            record(self.at)
        elif not fits:
            self._recorder.lost(loss)

    def _release(self, now: int) -> None:
        """Pass on what is held, in the order of arrival."""
        while True:
            with self._lock:
                if not self._held:
                    self._held = None
                    return
                held, self._held, self._held_bytes = self._held, [], 0
            for record, _ in held:
                record(lambda _: now)


def clock_time(channel: Channel, payload: bytes) -> int | None:
    """The time in a message of `/clock`, ns; None if it is none, or none that can be stored."""
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
    now = int(seconds) * 10**9 + int(nanoseconds)
    return now if 0 <= now < _MAX_NS else None


_MIN_JUMP_NS: Final = 500_000_000  # a smaller difference is a clock that is slowed or sped up


class MachineClock:
    """Notices, when it is looked at, that the clock was set: by `set_by` ns since the beginning.

    `now` returns its time, ns since the epoch, `monotonic` one that nobody sets, ns.
    """

    def __init__(
        self,
        now: Callable[[], int] = time.time_ns,
        monotonic: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.now = now
        self.monotonic = monotonic
        self.set_by = 0
        self._looked = monotonic()
        self._offset = now() - self._looked

    def look(self) -> tuple[int, int]:
        """By how much it was set since the last look, and at that moment by its new time, ns."""
        now, looked = self.now(), self._looked
        self._looked = self.monotonic()
        by = now - self._looked - self._offset
        self._offset += by
        if abs(by) < _MIN_JUMP_NS:
            by = 0
        self.set_by += by
        return by, now - (self._looked - looked)
