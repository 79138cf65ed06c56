"""Recording from a Foxglove WebSocket server: foxglove_bridge, or a program with its SDK.

Losses that can be detected, and those that cannot:

* A server queues messages for each client (the SDK 1024, the bridge some megabytes), and
  silently drops the oldest when a client is slow: the protocol has no sequence numbers.
  So this source has a thread that only reads. At tens of thousands of messages a second a
  queue of 1024 overflows within a moment: raise the server's `message_backlog_size`.
* ROS 1 messages that begin with a header carry a sequence number (see `sequence_gaps`).
  A gap is reported as lost in transport, wherever the messages were lost: in the
  publisher, the bridge or its queue. Other messages have no numbers.
* While the connection is down, the number of lost messages is unknown. Once the topic is
  back, the loss ledger gets a row without a count.

The server's log time of a message becomes its send time. With simulated time it may lie
in another century.
"""

from __future__ import annotations

from hybridlog.live.sources.base import LoopSource, Sink
from hybridlog.live.sources.foxglove.protocol import parse_address, without_user
from hybridlog_storage.errors import extra


class FoxgloveSource(LoopSource):
    """A client of one Foxglove WebSocket server. TLS certificates are checked.

    It reconnects after a second. Then the server's channels may have other
    numbers. A message of more than 1 GiB ends a connection, and is noted in the loss ledger.

    Args:
        url: Address, such as `ws://robot:8765`, optionally with user and password. Proxies
            of the environment are not used.
    """

    kind = "Foxglove"

    def __init__(self, url: str) -> None:
        super().__init__()
        self._url = url
        self.address = without_user(url)
        self.was_reached = False

    def check(self) -> None:
        """Check the address."""
        parse_address(self._url)

    def start(self, sink: Sink) -> None:
        """Begin to listen; the server need not be up yet."""
        address = parse_address(self._url)
        with extra("foxglove", "recording from Foxglove needs picows"):
            from hybridlog.live.sources.foxglove.connection import Client
        self._begin_loop(sink, Client(sink, address, self._reached).run)
