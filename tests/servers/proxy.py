"""A proxy before a server that breaks connections in the middle."""

from __future__ import annotations

import select
import socket
import struct
import threading
from contextlib import suppress
from typing import Self

_LOOK_S = 0.1  # seconds between two looks at whether it has ended


class Proxy:
    """Passes bytes on to a port of loopback, in threads of its own. A context manager.

    Args:
        target: Port of the server.

    Attributes:
        port: Its own port.
        reset_after: Bytes from the server after which a connection is reset; 0 for never.
        resets: Connections that were reset.
        left: Bytes from clients until their connections are cut; None for no cut.
    """

    def __init__(self, target: int) -> None:
        self.reset_after = 0
        self.resets = 0
        self.left: int | None = None
        self._target = target
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.settimeout(_LOOK_S)
        self.port = int(self._listener.getsockname()[1])
        self._threads = [threading.Thread(target=self._accept)]
        self._has_ended = False
        self._threads[0].start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._has_ended = True
        for thread in self._threads:
            thread.join()
        self._listener.close()

    def _accept(self) -> None:
        while not self._has_ended:
            with suppress(TimeoutError):
                ours, _ = self._listener.accept()
                thread = threading.Thread(target=self._pass, args=(ours,))
                self._threads.append(thread)
                thread.start()

    def _pass(self, ours: socket.socket) -> None:
        """Serve one connection."""
        passed = 0
        with (
            suppress(OSError),
            ours,
            socket.create_connection(("127.0.0.1", self._target)) as theirs,
        ):
            for one in (ours, theirs):
                one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            while not self._has_ended:
                for source in select.select([ours, theirs], [], [], _LOOK_S)[0]:
                    data = source.recv(1 << 16)
                    if not data:
                        return
                    if source is ours:
                        if self.left is not None:
                            data = data[: self.left]
                            self.left -= len(data)
                        theirs.sendall(data)
                        if self.left == 0:
                            return
                        continue
                    passed += len(data)
                    if self.reset_after and passed > self.reset_after:
                        ours.sendall(data[: self.reset_after - passed])
                        self.resets += 1
                        # Closing without lingering is a reset.
                        linger = struct.pack("ii", 1, 0)
                        ours.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
                        return
                    ours.sendall(data)
