"""One websocket connection to a Foxglove server, with a fast path for messages.

The `websockets` package handles closing, pings, texts and unusual frames. Nearly all
frames are whole binary ones with one message. This module parses them itself: a server
silently drops messages that are not read in time.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from io import BytesIO
from struct import Struct
from typing import Final

from websockets.frames import Frame, Opcode
from websockets.protocol import State

from hybridlog.live.sources.foxglove.handshake import TICK_S, Opened, reason_of
from hybridlog.live.sources.foxglove.protocol import (
    MAX_TEXT,
    MESSAGE_DATA,
    TIME,
    PeerError,
    Receiver,
)

_SEND_S: Final = 3.0
_CLOSE_S: Final = 1.0
_PING_S: Final = 10.0  # silence after which a ping is sent
_SILENT_S: Final = 20.0  # silence after which the connection counts as broken

_READ: Final = 1 << 17
_LARGE: Final = 1 << 16  # bytes from which a payload is read directly into its own memory
_MAX_CONTROL: Final = 125
_MAX_SKIPPED: Final = 16 << 30

_WHOLE_BINARY: Final = 0x82
_HEAD: Final = 13  # opcode, subscription, log time
_U16 = Struct(">H").unpack_from
_U64 = Struct(">Q").unpack_from
_IDS = Struct("<IQ").unpack_from
_TIME = Struct("<xQ")


class Connection:
    """A connection; one thread reads it and sends on it.

    Args:
        opened: The connection after its handshake. The caller closes it.
        max_message_bytes: Largest payload.
        stopped: Tells whether the source is stopped; called at least four times a second.
    """

    def __init__(self, opened: Opened, max_message_bytes: int, stopped: Callable[[], bool]) -> None:
        self._socket = opened.socket
        self._socket.settimeout(TICK_S)
        self._protocol = opened.protocol
        self._early = opened.early
        self._limit = max_message_bytes
        self._stopped = stopped
        self._quiet_s = 0.0
        self._is_pinged = False
        self._deadline: float | None = None
        self._owed = 0  # remaining bytes of a frame for websockets
        self._skip = 0  # remaining bytes of a skipped frame
        self._large: tuple[int, int, int, bytes] | None = None
        self._in_fragments = False
        self._gathered_is_text = False
        self._gathered = bytearray()

    # Reading.

    def read(self, receiver: Receiver) -> str:
        """Read until the connection ends or the source is stopped.

        Returns:
            How the server closed the connection; empty if this side did.

        Raises:
            PeerError: The connection broke, or the server violates the protocol.
        """
        data = self._early
        self._early = b""
        while True:
            at = self._take(data, receiver)
            receiver.look()
            if self._protocol.close_rcvd is not None:
                if self._deadline is not None:
                    return ""
                reason = self._protocol.close_rcvd.reason
                return "closed the connection" + (f" ({reason})" if reason else "")
            try:
                if self._large is not None:
                    self._fill(self._large, receiver)
                    self._large, data = None, b""
                    continue
                more = self._more(receiver)
            except PeerError:
                if self._deadline is not None:
                    return ""
                if self._large is None:
                    self._report_cut(data[at:], receiver)
                raise
            data = data[at:] + more if at < len(data) else more

    def _take(self, data: bytes, receiver: Receiver) -> int:
        """Take all whole frames; return the offset of the first unused byte."""
        take = receiver.data
        at, end = self._go_on(data, receiver), len(data)
        while end - at >= 2:
            length = data[at + 1]
            body = at + 2
            if length == 126:
                if end - at < 4:
                    break
                (length,) = _U16(data, body)
                body += 2
            elif length == 127:
                if end - at < 10:
                    break
                (length,) = _U64(data, body)
                body += 8
            elif length > 127:
                # Masked, which only clients may do: websockets reports it.
                self._hand_on(data[at:body], receiver)
                return end
            if data[at] != _WHOLE_BINARY or self._in_fragments:
                at = self._unusual(data, at, body, length, receiver)
                continue
            stop = body + length
            if stop <= end:
                if length >= _HEAD and data[body] == MESSAGE_DATA:
                    subscription, log_time = _IDS(data, body + 1)
                    take(subscription, log_time, data[body + _HEAD : stop])
                else:
                    self._other(data[body : min(stop, body + _HEAD)], receiver)
                at = stop
            elif length < _LARGE or end - body < _HEAD:
                break
            else:
                self._begin_large(data, body, length, receiver)
                return end
        return at

    def _go_on(self, data: bytes, receiver: Receiver) -> int:
        """Use the bytes of a frame that began earlier; returns their number."""
        if self._skip:
            used = min(self._skip, len(data))
            self._skip -= used
            return used
        if self._owed:
            used = min(self._owed, len(data))
            self._owed -= used
            self._hand_on(data[:used], receiver)
            return used
        return 0

    def _begin_large(self, data: bytes, body: int, length: int, receiver: Receiver) -> None:
        size, have = length - _HEAD, data[body + _HEAD :]
        subscription, log_time = _IDS(data, body + 1)
        if data[body] == MESSAGE_DATA and size <= self._limit:
            self._large = (subscription, log_time, size, have)
            return
        if length > _MAX_SKIPPED:
            raise PeerError(f"announces a message of {length} bytes; is it a Foxglove server?")
        if data[body] == MESSAGE_DATA:
            receiver.too_large(subscription, size)
        self._skip = size - len(have)

    def _fill(self, large: tuple[int, int, int, bytes], receiver: Receiver) -> None:
        """Read the rest of a large payload directly into its own memory.

        Memory is used only as bytes come: untouched pages of zeros take none.
        """
        subscription, log_time, size, have = large
        made = self._socket
        store = BytesIO(bytes(size))
        with store.getbuffer() as view:
            at = len(have)
            view[:at] = have
            while at < size:
                try:
                    count = self._more_into(made, view[at:])
                except PeerError:
                    if self._deadline is None:
                        receiver.cut(subscription)
                    raise
                at += count
        receiver.data(subscription, log_time, store.getvalue())

    def _other(self, head: bytes, receiver: Receiver) -> None:
        """Handle another binary message: the server's time; answers are not recorded."""
        if not head:
            receiver.broken("an empty binary message")
        elif head[0] == TIME:
            if len(head) < _TIME.size:
                receiver.broken(f"a time of {len(head)} bytes")
            else:
                receiver.time(_TIME.unpack_from(head)[0])
        elif head[0] == MESSAGE_DATA:
            receiver.broken(f"a message of {len(head)} bytes, shorter than its header")

    def _report_cut(self, rest: bytes, receiver: Receiver) -> None:
        """Report the message in which the connection broke, if its header is complete."""
        if self._in_fragments or self._owed:
            head = b"" if self._gathered_is_text else bytes(self._gathered[:5])
        elif rest[:1] == bytes([_WHOLE_BINARY]) and len(rest) > 1:
            body = {126: 4, 127: 10}.get(rest[1], 2)
            head = rest[body : body + 5]
        else:
            return
        if len(head) == 5 and head[0] == MESSAGE_DATA:
            receiver.cut(int.from_bytes(head[1:], "little"))

    # Frames for websockets.

    def _unusual(self, data: bytes, at: int, body: int, length: int, receiver: Receiver) -> int:
        """Pass the available bytes of a frame to websockets; return where the next one begins."""
        opcode, is_last = data[at] & 0x0F, bool(data[at] & 0x80)
        if opcode < 8:
            if opcode:
                self._gathered_is_text = opcode == Opcode.TEXT
            limit = MAX_TEXT if self._gathered_is_text else self._limit + _HEAD
            if len(self._gathered) + length > limit:
                kind = "JSON message" if self._gathered_is_text else "message in pieces"
                raise PeerError(f"sends a {kind} of more than {limit} bytes")
            self._in_fragments = not is_last
        elif length > _MAX_CONTROL:
            raise PeerError("violates the websocket protocol (a control frame is too long)")
        stop = min(body + length, len(data))
        self._owed = body + length - stop
        self._hand_on(data[at:stop], receiver)
        return stop

    def _hand_on(self, data: bytes, receiver: Receiver) -> None:
        self._protocol.receive_data(data)
        for event in self._protocol.events_received():
            if isinstance(event, Frame) and event.opcode in {
                Opcode.TEXT,
                Opcode.BINARY,
                Opcode.CONT,
            }:
                self._gathered += event.data
                if event.fin:
                    whole = bytes(self._gathered)
                    self._gathered.clear()
                    self._deliver(whole, receiver)
        try:
            self._flush()
        except PeerError:
            # A server that has closed need not get the answer.
            if self._protocol.close_rcvd is None:
                raise
        if self._protocol.parser_exc is not None:
            raise PeerError(f"violates the websocket protocol ({self._protocol.parser_exc})")

    def _deliver(self, whole: bytes, receiver: Receiver) -> None:
        if self._gathered_is_text:
            receiver.text(whole)
        elif len(whole) >= _HEAD and whole[0] == MESSAGE_DATA:
            subscription, log_time = _IDS(whole, 1)
            receiver.data(subscription, log_time, whole[_HEAD:])
        else:
            self._other(whole[:_HEAD], receiver)

    # Waiting, sending, closing.

    def _more(self, receiver: Receiver) -> bytes:
        """Receive at least one byte.

        Raises:
            PeerError: The connection has ended, or a deadline has passed.
        """
        made = self._socket
        while True:
            self._check_stop()
            try:
                data = made.recv(_READ)
            except TimeoutError:
                self._wait()
                receiver.look()
                continue
            except OSError as error:
                raise PeerError(reason_of(error)) from error
            if not data:
                raise PeerError("the connection broke")
            self._quiet_s = 0.0
            return data

    def _more_into(self, made: socket.socket, view: memoryview) -> int:
        """Receive at least one byte into a buffer; returns their number.

        Raises:
            PeerError: The connection has ended, or a deadline has passed.
        """
        while True:
            self._check_stop()
            try:
                count = made.recv_into(view)
            except TimeoutError:
                self._wait()
                continue
            except OSError as error:
                raise PeerError(reason_of(error)) from error
            if not count:
                raise PeerError("the connection broke in the middle of a message")
            self._quiet_s = 0.0
            return count

    def _check_stop(self) -> None:
        """Begin to close if the source is stopped; raise if closing takes too long."""
        if self._deadline is None:
            if self._stopped():
                self._begin_to_close()
        elif time.monotonic() > self._deadline:
            raise PeerError("does not close the connection")

    def _wait(self) -> None:
        """Handle a pause: ping the server, or give it up."""
        self._quiet_s += TICK_S
        if self._quiet_s >= _SILENT_S:
            raise PeerError(f"has been silent for {_SILENT_S:g} s")
        if self._quiet_s < _PING_S:
            self._is_pinged = False
        elif not self._is_pinged and self._protocol.state is State.OPEN:
            self._is_pinged = True
            self._protocol.send_ping(b"")
            self._flush()

    def _begin_to_close(self) -> None:
        """Send a close frame; messages under way still come."""
        self._deadline = time.monotonic() + _CLOSE_S
        if self._protocol.state is State.OPEN:
            self._protocol.send_close(1000)
            try:
                self._flush()
            except PeerError:
                # The server is gone already or does not read: do not wait.
                self._deadline = time.monotonic()

    def send(self, text: str) -> None:
        """Send a JSON message, unless the connection is closing.

        Raises:
            PeerError: The server does not read.
        """
        if self._protocol.state is State.OPEN:
            self._protocol.send_text(text.encode())
            self._flush()

    def _flush(self) -> None:
        made = self._socket
        for data in self._protocol.data_to_send():
            if not data:
                continue
            try:
                made.settimeout(_SEND_S)
                made.sendall(data)
            except TimeoutError as error:
                raise PeerError(f"has not read for {_SEND_S:g} s") from error
            except OSError as error:
                raise PeerError(reason_of(error)) from error
            finally:
                made.settimeout(TICK_S)
