"""One TCPROS connection after its handshake: splits the byte stream into messages.

Small messages are cut out of blocks, many per read. A large one is read separately after
its length, so that its bytes are copied only once, from the kernel into its own object. The
kernel wakes the reader when the message is complete. If more data waits, large messages are
cut out of blocks too: a read may wait for the interpreter, which costs more than a copy.
"""

from __future__ import annotations

import contextlib
import fcntl
import selectors
import socket
import struct
import termios
import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Final

from hybridlog.live.sources.base import Cause, Loss, Sink, one_line
from hybridlog.live.sources.sequence_gaps import (
    SequenceGap,
    SequenceGapDetector,
    has_sequence_numbers,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from hybridlog_storage.messages import Channel

u32: Final[Callable[..., tuple[int]]] = struct.Struct("<I").unpack_from
"""Reads the number at an offset of a buffer, as a tuple."""

_BLOCK: Final = 256 << 10
_LARGE: Final = 64 << 10
_PIECE: Final = 4 << 20
_WAKE: Final = 1 << 20
_NOTHING: Final = bytes(struct.calcsize("i"))


class Stream:
    """Reads one connection. All methods are called by one thread.

    Attributes:
        socket: Connected, not blocking; closed by `close`.
        closed: Called once by `close` with the error, empty after a regular end.
        failure: The error that ended `read`.
    """

    def __init__(
        self,
        connected: socket.socket,
        channel: Channel,
        sink: Sink,
        max_message_bytes: int,
        closed: Callable[[str], None],
    ) -> None:
        self.socket = connected
        self.closed = closed
        self.failure = ""
        self._channel = channel
        self._sink = sink
        self._limit = max_message_bytes
        self._block = self._shortest = min(_BLOCK, max_message_bytes + 4)
        self._longest = min(_PIECE, max_message_bytes + 4)
        self._gaps = SequenceGapDetector() if has_sequence_numbers(channel) else None
        self._publisher = f"publisher {one_line(channel.metadata.get('callerid', '') or 'unknown')}"
        # An incomplete message: its first bytes and the number of missing ones. Before its
        # length is complete: the bytes of the length.
        self._parts: list[bytes] = []
        self._missing = 0
        self._prefix = b""
        self._large = 0
        self._wakes_at = 1
        self._since = self._last = time.time_ns()
        # Linux enlarges the buffer to what it shall collect: while this thread cannot read,
        # messages wait here and not in the publisher's short queue.
        self._wake_at(_PIECE)
        self._wake_at(1)

    def read(self) -> bool:
        """Reads once, and passes on all complete messages; False at the end of the stream."""
        want = min(self._missing, _PIECE)
        if want < _LARGE:
            want = self._block if want or not self._large else self._next_large()
            want -= len(self._prefix)
        try:
            data = self.socket.recv(want)
        except BlockingIOError:
            return True
        except OSError as error:
            self.failure = f"the connection broke: {error.strerror or error}"
            # The kernel discards an unknown number of messages.
            self._sink.lost(
                Loss(
                    Cause.CONNECTION,
                    self._channel.topic,
                    None,
                    first=self._last,
                    last=time.time_ns(),
                    reason=f"{self._publisher}: {self.failure}",
                )
            )
            return False
        now = time.time_ns()
        if not data:
            self._cut_off(now)
            return False
        if len(data) == self._block:
            self._block = min(2 * self._block, self._longest)
        elif len(data) < self._block // 4:
            self._block = max(self._block // 2, self._shortest)
        alive = self._split(data, now)
        self._last = now
        return alive

    def finish(self) -> None:
        """Closes the socket, and reports the losses that are still unconfirmed."""
        self.socket.close()
        if self._gaps is not None:
            self._report(self._gaps.finish())

    def close(self) -> None:
        """Finishes, and calls `closed`."""
        self.finish()
        self.closed(self.failure)

    def _split(self, data: bytes, now: int) -> bool:
        """Splits the data of a read; False if the stream is malformed."""
        pos = 0
        if self._missing:
            pos = self._missing
            if len(data) < pos:
                self._parts.append(data)
                self._missing -= len(data)
                self._wake_at(min(self._missing, _WAKE))
                return True
            self._finish(data if len(data) == pos else data[:pos], now)
        if self._prefix:
            data = self._prefix + data
            self._prefix = b""
        pos = self._cut(data, pos, now)
        return pos == len(data) or self._begin(data, pos, now)

    def _finish(self, rest: bytes, now: int) -> None:
        """Passes on the message that was incomplete until now."""
        if self._parts:
            self._parts.append(rest)
            rest = b"".join(self._parts)
            self._parts = []
        self._missing = 0
        self._wake_at(1)
        self._large = len(rest) if len(rest) >= _LARGE else 0
        if self._gaps is None or len(rest) < 4:
            self._sink.take(self._channel, rest, received=now)
            return
        number = u32(rest, 0)[0]
        if number == self._gaps.expected:
            self._gaps.expected = number + 1 & 0xFFFFFFFF
        else:
            self._gaps.jump(number, self._last, now)
        self._sink.take(self._channel, rest, received=now, sequence=number)

    def _cut(self, data: bytes, pos: int, now: int) -> int:
        """Passes on all complete messages; returns the offset of the first incomplete one."""
        take, channel, length, gaps = self._sink.take, self._channel, u32, self._gaps
        last = len(data) - 4
        while pos <= last:
            start = pos + 4
            end = start + length(data, pos)[0]
            if end > last + 4:
                break
            if gaps is None or end - start < 4:
                take(channel, data[start:end], received=now)
            else:
                number = length(data, start)[0]
                if number == gaps.expected:
                    gaps.expected = number + 1 & 0xFFFFFFFF
                else:
                    gaps.jump(number, self._last, now)
                take(channel, data[start:end], received=now, sequence=number)
            pos = end
        if gaps is not None and gaps.waiting:
            self._report(gaps.confirmed())
        return pos

    def _begin(self, data: bytes, pos: int, now: int) -> bool:
        """Stores the beginning of a message; False if it is too long."""
        self._since = now
        if len(data) - pos < 4:
            self._prefix = data[pos:]
            return True
        size = u32(data, pos)[0]
        if size > self._limit:
            self.failure = f"it announced a message of {size} bytes; the limit is {self._limit}"
            detail = f"{self._publisher}: {self.failure}"
            self._sink.lost(Loss(Cause.UNREADABLE, self._channel.topic, 1, now, now, detail))
            return False
        begun = data[pos + 4 :]
        self._parts = [begun] if begun else []
        self._missing = size - len(begun)
        self._large = size if size >= _LARGE else 0
        self._wake_at(min(self._missing, _WAKE))
        return True

    def _next_large(self) -> int:
        """Number of bytes to read after a large message.

        Usually only the next length, so that the next large message gets its own object. If
        more than one message waits already, all waiting bytes.
        """
        answer = fcntl.ioctl(self.socket, termios.FIONREAD, _NOTHING)
        waiting = int(struct.unpack("i", answer)[0])
        return 4 if waiting <= self._large + 8 else min(waiting, self._longest)

    def _report(self, gaps: Sequence[SequenceGap]) -> None:
        """Reports messages that the publisher counted and that never came."""
        for gap in gaps:
            self._sink.lost(
                Loss(
                    Cause.TRANSPORT,
                    self._channel.topic,
                    gap.missing,
                    first=gap.first,
                    last=gap.last,
                    reason=f"{self._publisher}: dropped in its queue",
                )
            )

    def _cut_off(self, now: int) -> None:
        """Handles the end of the stream; an incomplete message is lost."""
        have = sum(map(len, self._parts)) + len(self._prefix)
        if not have and not self._missing:
            return
        of = f" of {have + self._missing}" if self._missing else ""
        self.failure = f"it closed in the middle of a message, after {have}{of} bytes"
        detail = f"{self._publisher}: {self.failure}"
        self._sink.lost(Loss(Cause.CONNECTION, self._channel.topic, 1, self._since, now, detail))

    def _wake_at(self, count: int) -> None:
        """Makes the kernel report the socket only when so many bytes are available.

        It also reports the end of the stream, and a full buffer.
        """
        count = count if count >= _LARGE else 1
        if count != self._wakes_at:
            self._wakes_at = count
            # A system without this option only wakes the reader more often.
            with contextlib.suppress(OSError):
                self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVLOWAT, count)


_LAST_READ_S: Final = 0.5


class Reader:
    """Reads streams until it is stopped.

    One thread is enough: the kernel copies large messages while other threads run, and Python
    splits small ones in one thread at a time anyway. `failed` is called in it with an unexpected
    error before it ends.
    """

    def __init__(self, failed: Callable[[BaseException], object]) -> None:
        self._failed = failed
        self._selector = selectors.DefaultSelector()
        self._wake, self._woken = socket.socketpair()
        self._wake.setblocking(False)
        self._woken.setblocking(False)
        self._selector.register(self._woken, selectors.EVENT_READ, None)
        self._lock = threading.Lock()
        self._new: deque[Stream] = deque()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="ros1-read", daemon=True)

    def start(self) -> None:
        """Starts the thread."""
        self._thread.start()

    def add(self, stream: Stream) -> None:
        """Adds a stream, which is closed when it or the reader ends."""
        with self._lock:
            stopped = self._stopping
            if not stopped:
                self._new.append(stream)
        if stopped:
            stream.socket.close()
        else:
            self._notify()

    def stop(self) -> None:
        """Reads pending messages for up to half a second, and closes all streams."""
        with self._lock:
            self._stopping = True
        self._notify()
        self._thread.join()

    def _notify(self) -> None:
        # A full pipe wakes the thread as well; a closed one has no thread.
        with contextlib.suppress(OSError):
            self._wake.send(b"\0")

    def _run(self) -> None:
        try:
            while not self._stopping:
                self._read(None)
            end = time.monotonic() + _LAST_READ_S
            while time.monotonic() < end and self._read(0):
                pass
        except BaseException as error:
            self._failed(error)
            raise
        finally:
            self._close()

    def _read(self, timeout: float | None) -> int:
        """Reads once from each stream with data; returns their number."""
        ready = self._selector.select(timeout)
        for key, _ in ready:
            stream: Stream | None = key.data
            if stream is None:
                self._admit()
            elif not stream.read():
                self._selector.unregister(stream.socket)
                stream.close()
        return len(ready)

    def _admit(self) -> None:
        """Registers added streams."""
        with contextlib.suppress(BlockingIOError):
            self._woken.recv(4096)
        while self._new:
            stream = self._new.popleft()
            self._selector.register(stream.socket, selectors.EVENT_READ, stream)

    def _close(self) -> None:
        with self._lock:
            self._stopping = True
        for key in list(self._selector.get_map().values()):
            if key.data is not None:
                key.data.finish()
        for stream in self._new:
            stream.socket.close()
        self._selector.close()
        self._wake.close()
        self._woken.close()
