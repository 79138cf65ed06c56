"""Tells a service manager such as systemd how the recorder is doing: `sd_notify(3)`."""

from __future__ import annotations

import os
import socket
from contextlib import suppress


def notify_service(*assignments: str) -> None:
    """Send assignments such as `READY=1` to the service manager; does nothing without one.

    Args:
        assignments: As `sd_notify(3)` describes them; no line breaks.
    """
    address = os.environ.get("NOTIFY_SOCKET", "")
    if address[:1] not in {"/", "@"}:
        return
    # It is a help, and must not stop a recording.
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as connection:
        connection.setblocking(False)
        place = f"\0{address[1:]}" if address[0] == "@" else address
        connection.sendto("\n".join(assignments).encode("utf-8", "replace"), place)
