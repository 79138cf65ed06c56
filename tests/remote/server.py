"""A server for buckets, behind a proxy of our own that counts, delays, cuts and refuses."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext, suppress
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Lock, Thread
from typing import Any

from tests.servers.mongods import free_port

KEEP = ("content-type", "content-range", "etag", "last-modified", "accept-ranges")


class Moto:
    """The server, in a process of its own."""

    def __init__(self, log: Path) -> None:
        self.port = free_port()
        code = f"from moto.server import main; main(['-H', '127.0.0.1', '-p', '{self.port}'])"
        with log.open("w") as errors:
            self._process = subprocess.Popen(
                [sys.executable, "-c", code],
                stdout=errors,
                stderr=errors,
                env={**os.environ, "S3_UPLOAD_PART_MIN_SIZE": "1000"},
            )
        until = time.monotonic() + 60
        while True:
            with suppress(OSError), socket.create_connection(("127.0.0.1", self.port), 1):
                return
            assert self._process.poll() is None, log.read_text()
            assert time.monotonic() < until
            time.sleep(0.05)

    def close(self) -> None:
        self._process.kill()
        self._process.wait()


class Proxy:
    """In front of the server.

    Attributes:
        requests: Method, object and range of each request so far.
        spoil: Called with the number of each request, from 1; says what becomes of it: "reset"
            before it reaches the server, "lost" after that, "503", "403", "cut" in the middle of
            the answer, "slow", "flip" for one bit of it and of the answer, or "" for nothing.
        without_conditions: Drop the conditions of writers, as some servers do.
    """

    def __init__(self, port: int) -> None:
        self.requests: list[tuple[str, str, str]] = []
        self.spoil: Callable[[int], str] = lambda _: ""
        self.without_conditions = False
        self._writing = Lock()
        outer = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_any(self) -> None:
                outer._pass_on(self, port)

            do_GET = do_PUT = do_POST = do_HEAD = do_DELETE = do_any  # noqa: N815

            def log_message(self, *_: Any) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._server.server_port}"
        self._thread = Thread(target=self._server.serve_forever, args=(0.05,), daemon=True)
        self._thread.start()

    def reset(self) -> None:
        """Forget the requests, and spoil none."""
        self.requests.clear()
        self.spoil = lambda _: ""
        self.without_conditions = False

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def _pass_on(self, client: BaseHTTPRequestHandler, port: int) -> None:
        headers = {name.lower(): value for name, value in client.headers.items()}
        self.requests.append((client.command, client.path, headers.get("range", "")))
        what = self.spoil(len(self.requests))
        body = client.rfile.read(int(headers.get("content-length", 0)))
        if what == "flip":
            body = _flipped(body)
        if what == "reset":
            _break(client)
            return
        if what in {"503", "403"}:
            client.send_response(int(what))
            client.send_header("content-length", "0")
            client.end_headers()
            return
        if self.without_conditions:
            headers = {n: v for n, v in headers.items() if n not in {"if-match", "if-none-match"}}
        # The server checks conditions before it writes: two of its threads may both be right.
        alone = self._writing if client.command == "PUT" else nullcontext()
        with alone, _Closing(HTTPConnection("127.0.0.1", port, timeout=60)) as server:
            server.request(client.command, client.path, body, headers)
            answer = server.getresponse()
            content = answer.read()
        if what == "flip":
            content = _flipped(content)
        if what == "lost":
            _break(client)
            return
        client.send_response(answer.status)
        for name in KEEP:
            if (value := answer.getheader(name)) is not None:
                client.send_header(name, value)
        length = answer.getheader("content-length", "0") if client.command == "HEAD" else None
        client.send_header("content-length", length or str(len(content)))
        client.end_headers()
        if what == "cut" and content:
            client.wfile.write(content[: len(content) // 2])
            client.wfile.flush()
            _break(client)
            return
        step = max(len(content) // 10, 1) if what == "slow" else max(len(content), 1)
        with suppress(OSError):  # the client has gone
            for begin in range(0, len(content), step):
                if what == "slow":
                    time.sleep(0.02)
                client.wfile.write(content[begin : begin + step])


def _flipped(data: bytes) -> bytes:
    return bytes([data[0] ^ 1]) + data[1:] if data else data


class _Closing:
    def __init__(self, connection: HTTPConnection) -> None:
        self._connection = connection

    def __enter__(self) -> HTTPConnection:
        return self._connection

    def __exit__(self, *_: object) -> None:
        self._connection.close()


def _break(client: BaseHTTPRequestHandler) -> None:
    client.close_connection = True
    linger = b"\x01\x00\x00\x00\x00\x00\x00\x00"
    client.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
    client.wfile = open(os.devnull, "wb")  # noqa: SIM115, PTH123
    client.connection.close()


def make_bucket(url: str, name: str) -> None:
    """Make a bucket."""
    host, _, port = url.removeprefix("http://").partition(":")
    with _Closing(HTTPConnection(host, int(port), timeout=60)) as server:
        server.request("PUT", f"/{name}")
        assert server.getresponse().status == 200
