"""Recording from a Foxglove WebSocket server: foxglove_bridge, or a program with its SDK.

What can be known of losses, and what cannot:

* A server keeps a number of messages for each of its clients (the SDK 1024, the bridge
  some megabytes), and drops the oldest when a client does not keep up. It tells nobody:
  the protocol has no numbers. So this source reads as fast as it can, and its reading
  thread does nothing else. At tens of thousands of messages a second 1024 are a moment
  that any busy computer can miss: give the server more (`message_backlog_size`).
* Messages of ROS 1 that begin with a header carry the number of their publisher, and a
  gap in what counted without gaps before is reported as lost in transport, wherever it
  was lost: in the publisher, in the bridge, or in its queue to us. Topics without a
  header, all of ROS 2 and all of the SDK's own types have nothing of that kind.
* While the connection is down, nobody knows what was sent: that is a row without a
  number, once the topic is back.

The server gives each message a time of its own clock, its log time: it becomes the time
of sending. With simulated time that may be no time of this century.
"""

from __future__ import annotations

import threading
from typing import Final

from hybridlog.live.sources.base import LiveSource, Sink
from hybridlog.live.sources.foxglove.protocol import parse_address, without_user
from hybridlog_storage.errors import MissingDependencyError, UsageError

_JOIN_S: Final = 5.0
_MIN_LIMIT: Final = 1 << 20


class FoxgloveSource(LiveSource):
    """A client of one Foxglove WebSocket server. Its certificate is checked as ever.

    A server that is away, or becomes so, is tried again with growing pauses. Its
    channels may come back under any number.

    Args:
        url: Address, such as `ws://robot:8765`; user and password may stand before the
            host. Proxies of the environment are not used.
        max_message_bytes: Largest payload that is taken, at least 1 MiB. Larger ones are
            passed over, and are rows of the loss ledger.

    Raises:
        UsageError: The limit is too small.
    """

    kind = "Foxglove"

    def __init__(self, url: str, *, max_message_bytes: int = 1 << 30) -> None:
        if max_message_bytes < _MIN_LIMIT:
            raise UsageError("the largest message must be allowed at least 1 MiB")
        self._url = url
        self.address = without_user(url)
        self.was_reached = False
        self._limit = max_message_bytes
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def check(self) -> None:
        """Refuse an address that is none.

        Raises:
            UsageError: It is none.
        """
        parse_address(self._url)

    def start(self, sink: Sink) -> None:
        """Begin to listen; a server that is not there yet is waited for.

        Raises:
            UsageError: The address is none.
            MissingDependencyError: `websockets` is not installed.
        """
        address = parse_address(self._url)
        try:
            from hybridlog.live.sources.foxglove.client import Client
        except ImportError as error:
            raise MissingDependencyError(
                "recording from Foxglove needs websockets: pip install 'hybridlog[foxglove]'"
            ) from error
        client = Client(sink, address, self._limit, self._stop, self._reached)
        self._thread = threading.Thread(target=client.run, name="hybridlog-foxglove", daemon=True)
        self._thread.start()

    def _reached(self) -> None:
        self.was_reached = True

    def stop(self) -> None:
        """Say goodbye, take what is under way, and close.

        Only the name of a host that no name server answers for may hold the thread
        longer; it then ends without another word to the sink.
        """
        self._stop.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(_JOIN_S)
