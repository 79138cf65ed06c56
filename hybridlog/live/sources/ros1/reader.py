"""The thread that reads the sockets of all publishers."""

from __future__ import annotations

import contextlib
import selectors
import socket
import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable

    from hybridlog.live.sources.ros1.stream import Stream

_LAST_READ_S: Final = 0.5


class Reader:
    """Reads streams until it is stopped.

    One thread is enough: the kernel copies large messages while other threads run, and Python
    splits small ones in one thread at a time anyway. `failed` is called in it with an unexpected
    error before it ends.
    """

    def __init__(self, failed: Callable[[BaseException], None]) -> None:
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
