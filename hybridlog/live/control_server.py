"""Control socket of a running recorder: state, marks, stop.

The server listens on a unix socket that only its owner can open. A client sends one JSON
object on a line and gets one back. While the recorder runs, a socket file in the store's
directory `recorders` holds the path of the socket.
"""

from __future__ import annotations

import json
import os
import re
import socket
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hybridlog_storage.disk import files
from hybridlog_storage.disk.socket_directory import is_our_socket, new_socket
from hybridlog_storage.errors import HybridlogError, StoreError, UsageError
from hybridlog_storage.manifests import DiskManifests
from hybridlog_storage.remote import address_of
from hybridlog_storage.settings import NAME
from hybridlog_storage.stopping import pause

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

Answer = Callable[[Mapping[str, Any]], Mapping[str, Any]]
"""Computes the answer to a request; raises `HybridlogError` to refuse it."""

_ODD = re.compile(r"[^A-Za-z0-9._-]+")
_SOCKET_FILES = "recorders"
_SUFFIX = ".json"

_MAX_SOCKET_FILE = 1 << 16  # bytes
_MAX_REQUEST = 1 << 20  # bytes of a request; answers may be longer
_MAX_ANSWER = 1 << 26
_TIMEOUT_S = 5.0
_MAX_CLIENTS = 8


class ControlServer:
    """Answers requests of other processes until it is closed.

    Args:
        store: The store's directory.
        recorder: Id of its recording, or another word that no other recorder has.
        name: Name of the recorder, which is that of its recording.
        requests: Handler of each kind of request.

    Raises:
        StoreError: The socket cannot be created.
    """

    def __init__(
        self, store: Path, recorder: str, name: str, requests: Mapping[str, Answer]
    ) -> None:
        self.name = name
        self._requests = requests
        self._socket_file = _socket_file(store, recorder)
        self._path = new_socket(store, "control.sock")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._socket.bind(str(self._path))
            self._socket.listen(_MAX_CLIENTS)
        except OSError as error:
            self.close()
            raise StoreError(
                f"The recorder's socket {self._path} cannot be created: {error.strerror}."
            ) from error
        try:
            self._write_socket_file()
        except OSError as error:
            self.close()
            raise StoreError(
                f"The socket file {self._socket_file} cannot be created: {error.strerror}. "
                f"Check the owner of {self._socket_file.parent}, and that it is a folder and "
                "not a symlink."
            ) from error
        self._free_clients = threading.BoundedSemaphore(_MAX_CLIENTS)
        self._thread = threading.Thread(target=self._serve, name="hybridlog-control", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop answering, and remove socket and socket file."""
        # Closing alone does not wake a thread in `accept`.
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        with suppress(OSError):
            files.unlink(self._socket_file)
        with suppress(OSError):
            self._path.unlink()
        with suppress(OSError):
            self._path.parent.rmdir()

    def _write_socket_file(self) -> None:
        with suppress(FileExistsError):
            files.make_folder(self._socket_file.parent)
        said = {"socket": str(self._path), "pid": os.getpid(), "name": self.name}
        content = json.dumps(said) + "\n"
        files.write_file(self._socket_file, content.encode(), sync=False)

    def _serve(self) -> None:
        while True:
            try:
                client, _ = self._socket.accept()
            except OSError:
                return  # closed
            if self._free_clients.acquire(timeout=_TIMEOUT_S):
                threading.Thread(target=self._handle, args=(client,), daemon=True).start()
            else:
                client.close()

    def _handle(self, client: socket.socket) -> None:
        """Answer one client, unless it is silent or its request is too long."""
        try:
            with client, suppress(OSError):
                client.settimeout(_TIMEOUT_S)
                line = _line(client, _MAX_REQUEST)
                client.sendall(json.dumps(self._answer(line)).encode() + b"\n")
        finally:
            self._free_clients.release()

    def _answer(self, line: bytes) -> Mapping[str, Any]:
        try:
            request = json.loads(line)
            answer = self._requests[request["ask"]]
        except (ValueError, KeyError, TypeError, RecursionError):
            known = ", ".join(sorted(self._requests))
            return {"error": f"unknown request; choose one of: {known}", "exit_code": 2}
        try:
            return answer(request)
        except HybridlogError as error:
            return {"error": str(error), "exit_code": error.exit_code}


def running(store: Path) -> dict[str, str]:
    """Names of the recorders that run on a store, by their ids, in the order of their start."""
    found: list[tuple[float, str, str]] = []
    try:
        socket_files = files.names(store / _SOCKET_FILES)
    except OSError:
        return {}
    for file_name, about in socket_files.items():
        recorder, suffix = os.path.splitext(file_name)  # noqa: PTH122 - not a path
        if suffix != _SUFFIX or file_name[0] == ".":
            continue
        # A recorder that was killed leaves its socket file behind.
        with suppress(OSError, StoreError):
            _connect(store, recorder).close()
            found.append((about.st_mtime, recorder, _name_now(store, recorder)))
    return {recorder: name for _, recorder, name in sorted(found)}


def request(store: Path, recorder: str, ask: str, **content: Any) -> dict[str, Any]:
    """Send a request to a running recorder, by its id.

    Raises:
        StoreError: The recorder does not answer.
        UsageError: The recorder refuses.
    """
    try:
        with _connect(store, recorder) as connection:
            connection.sendall(json.dumps({"ask": ask, **content}).encode() + b"\n")
            answer = json.loads(_line(connection, _MAX_ANSWER))
    except (OSError, ValueError) as error:
        raise StoreError(_gone(recorder)) from error
    if not isinstance(answer, dict):
        raise StoreError(_gone(recorder))
    if "error" in answer:
        raise UsageError(str(answer["error"]))
    return answer


def _socket_file(store: Path, recorder: str) -> Path:
    return store / _SOCKET_FILES / f"{_ODD.sub('-', recorder).strip('-.') or '-'}{_SUFFIX}"


def _gone(recorder: str) -> str:
    return f"The recorder {recorder!r} does not answer; it has ended or was killed."


def _read(store: Path, recorder: str) -> tuple[str, str]:
    """The path of a recorder's socket, and its name.

    Raises:
        StoreError: No socket exists, or it belongs to another user.
    """
    try:
        said = json.loads(files.read_file(_socket_file(store, recorder), _MAX_SOCKET_FILE))
        path, name = said["socket"], said["name"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise StoreError(_gone(recorder)) from error
    if not (isinstance(path, str) and isinstance(name, str) and is_our_socket(path)):
        raise StoreError(_gone(recorder))
    return path, name


def _name_now(store: Path, recorder: str) -> str:
    """The name of a recorder's recording, which may have another one by now."""
    with suppress(HybridlogError):
        return DiskManifests(store).read(recorder).name
    return _read(store, recorder)[1]


def _connect(store: Path, recorder: str) -> socket.socket:
    """A connection to a recorder's socket.

    Raises:
        StoreError: No socket exists, or it belongs to another user.
        OSError: The recorder does not answer.
    """
    path, _ = _read(store, recorder)
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        connection.settimeout(_TIMEOUT_S)
        connection.connect(path)
    except BaseException:
        connection.close()
        raise
    return connection


def states(store: Path, recorder: str, every_s: float) -> Iterator[dict[str, Any]]:
    """Poll the state of a recorder until it ends."""
    while True:
        started = time.monotonic()
        try:
            yield request(store, recorder, "state")
        except StoreError:
            return
        pause(max(every_s - (time.monotonic() - started), 0))


def _line(connection: socket.socket, max_bytes: int) -> bytes:
    parts: list[bytes] = []
    size = 0
    while True:
        part = connection.recv(1 << 16)
        parts.append(part)
        size += len(part)
        if not part or part.endswith(b"\n"):
            return b"".join(parts)
        if size > max_bytes:
            raise OSError("the message is too long")


def choose(store: Path, named: Sequence[str]) -> list[str]:
    """The ids of running recorders; without names, the only one.

    Args:
        store: The store's directory.
        named: Names by the user: id or name of a recording, the beginning of one, or that of
            the digits of its id.

    Raises:
        UsageError: No recorder runs, several run and no name is given, or a name matches
            none or several.
        StoreError: There is no store.
    """
    names = running(store)
    if named:
        return list(dict.fromkeys(_resolve(name, names) for name in named))
    if not names:
        if address_of(store) is not None:
            raise UsageError(
                f"No recorder runs in the bucket of {store}; `hybridlog mark --at` marks "
                "recordings there."
            )
        if not (store / NAME).is_file():
            raise StoreError(
                f"{store} is no store: no recorder runs there; start one with `hybridlog record`."
            )
        raise UsageError("No recorder runs on this store; start one with `hybridlog record`.")
    if len(names) > 1:
        raise UsageError(f"Several recorders run; name one of {', '.join(names.values())}.")
    return [*names]


def _resolve(name: str, recorders: Mapping[str, str]) -> str:
    """The id of the running recorder that a user's name means.

    Raises:
        UsageError: No recorder matches, or several do.
    """
    fitting = (
        [one for one, known in recorders.items() if name in {one, known}]
        or [one for one, known in recorders.items() if name and known.startswith(name)]
        or [
            one
            for one in recorders
            if name and (one.startswith(name) or one[-16:].startswith(name))
        ]
    )
    if len(fitting) > 1:
        found = ", ".join(recorders[one] for one in fitting)
        raise UsageError(f"{name!r} is ambiguous: it may be {found}.")
    if not fitting:
        known = ", ".join(recorders.values()) or "none"
        raise UsageError(f"No running recorder matches {name!r}; running: {known}.")
    return fitting[0]
