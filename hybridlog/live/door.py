"""The door of a running recorder: other processes ask it, mark, trigger, stop.

A unix socket that only its owner can open. A visitor sends one JSON object on a line and
gets one back. Where it is stands in a small file in the store's directory `recorders`,
for as long as the recorder runs.
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

from hybridlog_storage import files
from hybridlog_storage.errors import HybridlogError, StoreError, UsageError
from hybridlog_storage.socket_directory import is_our_socket, new_socket

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

Answer = Callable[[Mapping[str, Any]], Mapping[str, Any]]
"""What a request gets; raises `HybridlogError` to refuse."""

_ODD = re.compile(r"[^A-Za-z0-9._-]+")
_SIGNS = "recorders"
_SUFFIX = ".json"

_LONGEST_SIGN = 1 << 16  # bytes
_LONGEST = 1 << 20  # bytes of a request; answers may be longer
_LONGEST_ANSWER = 1 << 26
_PATIENCE_S = 5.0
_VISITORS = 8


class Door:
    """Answers visitors, until it is closed.

    Args:
        store: The store's directory.
        name: Of the recorder: that of its recording.
        requests: What can be asked for, by word.

    Raises:
        StoreError: The socket cannot be made.
    """

    def __init__(self, store: Path, name: str, requests: Mapping[str, Answer]) -> None:
        self.name = name
        self._requests = requests
        self._sign = _sign(store, name)
        self._path = new_socket(store, "door.sock")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._socket.bind(str(self._path))
            self._socket.listen(_VISITORS)
        except OSError as error:
            self.close()
            raise StoreError(
                f"The recorder's socket {self._path} cannot be made: {error.strerror}."
            ) from error
        try:
            self._put_up_sign()
        except OSError as error:
            self.close()
            raise StoreError(
                f"{self._sign}, which says where the recorder is reached, cannot be made: "
                f"{error.strerror}. Check the owner of {self._sign.parent}, and that it is a "
                f"folder and no symlink."
            ) from error
        self._places = threading.BoundedSemaphore(_VISITORS)
        self._thread = threading.Thread(target=self._serve, name="hybridlog-door", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Let nobody in any more."""
        # Closing alone does not wake who waits in `accept`.
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        with suppress(OSError):
            files.unlink(self._sign, depth=files.IN_FOLDER)
        with suppress(OSError):
            self._path.unlink()
        with suppress(OSError):
            self._path.parent.rmdir()

    def _put_up_sign(self) -> None:
        with suppress(FileExistsError):
            files.make_folder(self._sign.parent, depth=files.IN_STORE)
        content = json.dumps({"socket": str(self._path), "pid": os.getpid()}) + "\n"
        files.write_file(self._sign, content.encode(), depth=files.IN_FOLDER, sync=False)

    def _serve(self) -> None:
        while True:
            try:
                visitor, _ = self._socket.accept()
            except OSError:
                return  # closed
            if self._places.acquire(timeout=_PATIENCE_S):
                threading.Thread(target=self._welcome, args=(visitor,), daemon=True).start()
            else:
                visitor.close()

    def _welcome(self, visitor: socket.socket) -> None:
        """Answer one visitor; one that says nothing, or never ends, is let go."""
        try:
            with visitor, suppress(OSError):
                visitor.settimeout(_PATIENCE_S)
                line = _line(visitor, _LONGEST)
                visitor.sendall(json.dumps(self._answer(line)).encode() + b"\n")
        finally:
            self._places.release()

    def _answer(self, line: bytes) -> Mapping[str, Any]:
        try:
            request = json.loads(line)
            answer = self._requests[request["ask"]]
        except (ValueError, KeyError, TypeError, RecursionError):
            known = ", ".join(sorted(self._requests))
            return {"error": f"no such request; there are: {known}", "exit_code": 2}
        try:
            return answer(request)
        except HybridlogError as error:
            return {"error": str(error), "exit_code": error.exit_code}


def running(store: Path) -> list[str]:
    """Names of the recorders that run on a store, the latest last.

    Args:
        store: The store's directory.
    """
    found: list[tuple[float, str]] = []
    try:
        signs = files.names(store / _SIGNS, depth=files.IN_STORE)
    except OSError:
        return []
    for sign, about in signs.items():
        name, suffix = os.path.splitext(sign)  # noqa: PTH122 - not a path
        if suffix != _SUFFIX or sign[0] == ".":
            continue
        # A recorder that was killed has left its sign behind.
        with suppress(OSError, StoreError):
            _connect(store, name).close()
            found.append((about.st_mtime, name))
    return [name for _, name in sorted(found)]


def visit(store: Path, name: str, ask: str, **content: Any) -> dict[str, Any]:
    """Ask a running recorder.

    Args:
        store: The store's directory.
        name: The recorder's name.
        ask: The word of the request.
        content: What belongs to it.

    Raises:
        StoreError: Nobody answers.
        UsageError: The recorder refuses.
    """
    try:
        with _connect(store, name) as connection:
            connection.sendall(json.dumps({"ask": ask, **content}).encode() + b"\n")
            answer = json.loads(_line(connection, _LONGEST_ANSWER))
    except (OSError, ValueError) as error:
        raise StoreError(_gone(name)) from error
    if not isinstance(answer, dict):
        raise StoreError(_gone(name))
    if "error" in answer:
        raise UsageError(str(answer["error"]))
    return answer


def _sign(store: Path, name: str) -> Path:
    return store / _SIGNS / f"{_as_id(name)}{_SUFFIX}"


def _as_id(name: str) -> str:
    """What a name becomes in an id, and in the name of a file."""
    return _ODD.sub("-", name).strip("-.") or "-"


def _gone(name: str) -> str:
    return f"No recorder answers for {name!r}; it has ended, or was killed."


def _connect(store: Path, name: str) -> socket.socket:
    """A connection to a recorder's door.

    Raises:
        StoreError: There is none, or it is not one of this user's.
        OSError: Nobody answers.
    """
    try:
        text = files.read_file(_sign(store, name), _LONGEST_SIGN, depth=files.IN_FOLDER)
        path = json.loads(text)["socket"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise StoreError(_gone(name)) from error
    if not isinstance(path, str) or not is_our_socket(path):
        raise StoreError(_gone(name))
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        connection.settimeout(_PATIENCE_S)
        connection.connect(path)
    except BaseException:
        connection.close()
        raise
    return connection


def states(store: Path, name: str, every_s: float) -> Iterator[dict[str, Any]]:
    """What a recorder says of itself, again and again; ends when it has ended."""
    while True:
        started = time.monotonic()
        try:
            yield visit(store, name, "state")
        except StoreError:
            return
        time.sleep(max(every_s - (time.monotonic() - started), 0))


def _line(connection: socket.socket, longest: int) -> bytes:
    parts: list[bytes] = []
    size = 0
    while True:
        part = connection.recv(1 << 16)
        parts.append(part)
        size += len(part)
        if not part or part.endswith(b"\n"):
            return b"".join(parts)
        if size > longest:
            raise OSError("too long")


def choose(store: Path, named: Sequence[str]) -> list[str]:
    """The running recorders that are meant: those named, or the only one.

    Args:
        store: The store's directory.
        named: As the user has named them: id or name of the recording, or the beginning of
            the id. A recorder with a ring goes by the name that its snapshots will have.

    Raises:
        UsageError: There is none, or there are several and none was named, or a name fits
            none or several.
    """
    there = running(store)
    if named:
        return list(dict.fromkeys(_named(name, there) for name in named))
    if not there:
        raise UsageError(
            "Nothing is being recorded into this store now; start with `hybridlog record`."
        )
    if len(there) > 1:
        raise UsageError(f"Several recordings are being made: name one of {', '.join(there)}.")
    return there


def _named(name: str, there: Sequence[str]) -> str:
    """The running recorder that a name stands for.

    Raises:
        UsageError: None, or several.
    """
    wanted = _as_id(name)
    ring = re.compile(rf"{re.escape(wanted)}-ring-\d+")
    fitting = (
        [one for one in there if one == name]
        or [one for one in there if one == wanted]
        or [one for one in there if ring.fullmatch(one)]
        or [one for one in there if name and one.startswith(name)]
    )
    if len(fitting) > 1:
        raise UsageError(f"{name!r} may be {', '.join(fitting)}: write more of it.")
    if not fitting:
        what = ", ".join(there) or "nothing"
        raise UsageError(f"{name!r} is not being recorded now; what is: {what}.")
    return fitting[0]
