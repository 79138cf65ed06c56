"""Copies to a server: hybridlog runs there, started over ssh, and writes the files itself.

Both sides talk over standard input and output in frames: two lengths, a JSON object, and
bytes. The client asks what a `Place` can do; every question has one answer, in order. Bytes of
files are sent on while a few answers are outstanding. Neither side trusts the other: frames
are bounded, names and sizes are checked, and the server writes only into its store. The client
says all the while that it is there, and a server that hears nothing gives up.
"""

from __future__ import annotations

import json
import select
import shlex
import struct
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from threading import Event, Lock
from typing import IO, TYPE_CHECKING, Any, Final
from urllib.parse import unquote, urlsplit

from hybridlog.maintenance.places import Begun, Copied, CopiedFile, CopiedSegment, RefusedError
from hybridlog_storage.errors import (
    DiskFullError,
    HeldError,
    HybridlogError,
    StoreError,
    UsageError,
)
from hybridlog_storage.manifest import MAX_BYTES
from hybridlog_storage.threads import Threads

if TYPE_CHECKING:
    from hybridlog.maintenance.places import DirectoryPlace
    from hybridlog_storage.messages import Buffer

DEFAULT_SSH: Final = "ssh -o ServerAliveInterval=15"
"""Notices within a minute that a connection is dead."""
_PROTOCOL: Final = 3
_HEAD: Final = struct.Struct(">II")
_MAX_VALUE: Final = 1 << 20  # bytes of a JSON object
_MAX_BODY: Final = MAX_BYTES  # of a manifest; pieces of files are smaller
_MAX_AHEAD: Final = 16  # pieces of files without an answer
_MAX_TEXT: Final = 2000  # characters of a message of the other side
_IDLE_S: Final = 60.0
"""Seconds of silence after which the server gives up: the connection is cut."""
_BEAT_S: Final = 10.0
"""Seconds between two signs of life, however long the client reads its own files."""
_BEAT: Final = {"do": "beat"}
_ERRORS: Final = {"full": DiskFullError, "refused": RefusedError}
"""Errors that the other side is told by a word."""
_NOT_FOUND: Final = 127  # exit code of a shell
_NOT_REACHED: Final = 255  # exit code of ssh


def is_ssh(to: str) -> bool:
    """True for the URL of a store on a server."""
    return to.startswith("ssh://")


@contextmanager
def ssh_place(url: str, ssh: str | None, program: str) -> Iterator[Server]:
    """A store on a server.

    Args:
        url: `ssh://user@host:port/path`; `/~/path` is below the home directory.
        ssh: The ssh program, with options; None for `ssh`.
        program: hybridlog on the server.

    Raises:
        UsageError: It is no such URL.
        StoreError: The server is not reached, or hybridlog does not run there.
    """
    command = [*shlex.split(ssh or DEFAULT_SSH), *_words(url, program)]
    try:
        process = subprocess.Popen(  # noqa: S603 - the user named it
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
    except OSError as error:
        raise StoreError(f"{command[0]} cannot be started: {error.strerror}.") from error
    requests, answers = process.stdin, process.stdout
    assert requests is not None
    assert answers is not None
    server = None
    try:
        server = Server(url, requests, answers)
        with server.beating():
            yield server
    except StoreError as error:
        code = None
        with suppress(subprocess.TimeoutExpired):
            code = process.wait(2)
        if code == _NOT_FOUND:
            raise StoreError(f"{error} Name hybridlog on the server: --program.") from error
        if code == _NOT_REACHED and server is None:
            raise StoreError(f"{url} could not be reached.") from error
        raise
    finally:
        for stream in (requests, answers):
            with suppress(OSError):  # bytes that could not be sent
                stream.close()
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


class Server:
    """A store behind a connection: as of `Place`.

    Raises:
        StoreError: There is no hybridlog on the other side.
    """

    proves = True

    def __init__(self, name: str, requests: IO[bytes], answers: IO[bytes]) -> None:
        self.name = name
        self._requests = requests
        self._answers = answers
        self._sending = Lock()
        self._ahead = 0  # requests without an answer
        self._is_cut = self._is_met = False
        if self._receive().get("hybridlog") != _PROTOCOL:
            raise StoreError(f"hybridlog of {self.name} is of another version.")
        self._is_met = True

    @contextmanager
    def beating(self) -> Iterator[None]:
        """Say all the while that this side is there."""
        ended = Event()

        def beat() -> None:
            with suppress(OSError, ValueError):  # it is cut, as the next request finds
                while not ended.wait(_BEAT_S):
                    with self._sending:
                        _write(self._requests, _BEAT)

        with Threads(1, "beat") as threads:
            threads.submit(beat)
            try:
                yield
            finally:
                ended.set()

    def sees(self, mark: str) -> bool:
        """As of `Place`."""
        return self._ask("sees", mark=mark) is not False

    def have(self, recordings: Sequence[str]) -> dict[str, Copied]:
        """As of `Place`."""
        found = _mapping(self._ask("have", recordings=[*recordings]))
        return {one: _copied(value) for one, value in found.items() if one in recordings}

    def segments(self, recording: str) -> dict[int, CopiedSegment]:
        """As of `Place`."""
        found = _mapping(self._ask("segments", recording=recording))
        return {
            int(number): CopiedSegment(str(one[0]), tuple(map(str, one[1])))
            for number, one in found.items()
            if number.isdigit() and isinstance(one, list) and list(map(type, one)) == [str, list]
        }

    def begin(self, recording: str, *, wants_payloads: bool) -> Begun:
        """As of `Place`."""
        found = _mapping(self._ask("begin", recording=recording, wants_payloads=wants_payloads))
        known = None if found.get("known") is None else _copied(found["known"])
        sizes = _mapping(found.get("sizes"))
        return Begun(known, {name: n for name, n in sizes.items() if type(n) is int})

    def digest(self, file: CopiedFile, length: int) -> str:
        """As of `Place`."""
        return str(self._ask("digest", file=file.to_json(), length=length))

    def append(self, file: CopiedFile, at: int, data: Buffer) -> None:
        """As of `Place`; what fails there may be raised by one of the next calls."""
        self._send({"do": "append", "file": file.to_json(), "at": at}, data)
        while self._ahead > _MAX_AHEAD:
            self._answer()

    def prove(self, file: CopiedFile) -> bool:
        """As of `Place`."""
        return self._ask("prove", file=file.to_json()) is True

    def publish(self, data: bytes) -> str:
        """As of `Place`."""
        return str(self._ask("publish", data))

    def hold(self, recordings: Sequence[str]) -> bool:
        """As of `Place`."""
        return self._ask("hold", recordings=[*recordings]) is True

    def drop(self) -> None:
        """As of `Place`."""
        self._ask("drop")

    def leave(self) -> None:
        """As of `Place`."""
        while self._ahead and not self._is_cut:
            with suppress(StoreError, DiskFullError):  # one was raised before
                self._answer()
        if not self._is_cut:
            self._ask("leave")

    def problems(self, recording: str) -> list[str]:
        """As of `Place`."""
        found = self._ask("problems", recording=recording)
        return [_shown(one) for one in found] if isinstance(found, list) else ["no answer"]

    def _ask(self, what: str, body: Buffer = b"", **values: Any) -> Any:
        self._send({"do": what, **values}, body)
        while self._ahead > 1:
            self._answer()
        return self._answer()

    def _send(self, value: Mapping[str, Any], body: Buffer) -> None:
        try:
            with self._sending:
                _write(self._requests, value, body)
        except (OSError, ValueError) as error:  # a stream that is closed raises ValueError
            raise self._cut() from error
        self._ahead += 1

    def _answer(self) -> Any:
        answer = self._receive()
        self._ahead -= 1
        if "error" in answer:
            text = f"{self.name}: {_shown(answer['error'])}"
            if answer.get("kind") == "held":
                raise HeldError(text, is_recording=False)
            raise _ERRORS.get(str(answer.get("kind")), StoreError)(text)
        return answer.get("value")

    def _receive(self) -> dict[str, Any]:
        try:
            found = _read(self._answers)
        except ValueError as error:
            self._is_cut = True
            raise StoreError(
                f"{self.name} does not answer as hybridlog does ({error}). If a shell there "
                "prints something when it starts, let it print only on a terminal."
            ) from error
        except OSError as error:
            raise self._cut() from error
        if found is None:
            raise self._cut()
        return found[0]

    def _cut(self) -> StoreError:
        self._is_cut = True
        if not self._is_met:
            return StoreError(f"hybridlog of {self.name} has not answered.")
        return StoreError(
            f"The connection to {self.name} has ended. What arrived stays there: run the command "
            "again."
        )


def _words(url: str, program: str) -> list[str]:
    """Arguments of the ssh program."""
    try:
        parts = urlsplit(url)
        port, host = parts.port, parts.hostname or ""
    except ValueError as error:
        raise UsageError(f"{url!r} is no URL: {error}.") from error
    user = unquote(parts.username or "")
    path = unquote(parts.path)
    path = path.removeprefix("/~/")
    if not host or host.startswith("-") or user.startswith("-") or not path.strip("/"):
        raise UsageError(f"Write ssh://user@host/path, not {url!r}.")
    if parts.password or parts.query or parts.fragment or not url.isprintable():
        raise UsageError("ssh://user@host/path has no password; ssh asks, or takes a key.")
    words = [] if port is None else ["-p", str(port)]
    command = f"{program} copy --receive -- {shlex.quote(path)}"
    return [*words, f"{user}@{host}" if user else host, command]


def serve(place: DirectoryPlace, requests: IO[bytes], answers: IO[bytes]) -> None:
    """Do what the other side asks until it ends.

    Raises:
        StoreError: It does not speak this protocol, or is silent.
    """
    heard = _Heard(requests)
    _write(answers, {"hybridlog": _PROTOCOL})
    try:
        while (found := _read(heard)) is not None:
            request, body = found
            if request == _BEAT:
                continue
            try:
                _write(answers, {"value": _ANSWERS[request["do"]](place, request, body)})
            except HybridlogError as error:
                _write(answers, {"error": str(error)[:_MAX_TEXT], "kind": _kind(error)})
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise StoreError(f"The other side asks what no copy asks: {error!r}") from error
    except BrokenPipeError:
        pass  # it has ended
    finally:
        place.leave()


class _Heard:
    """A stream from the other side; reading fails when that is silent for too long."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream

    def read(self, size: int) -> bytes:
        if not select.select([self._stream], [], [], _IDLE_S)[0]:
            raise StoreError("The other side is silent; what it has sent stays.")
        return self._stream.read(size)


def _kind(error: HybridlogError) -> str:
    if isinstance(error, HeldError):
        return "held"
    return next((kind for kind, one in _ERRORS.items() if isinstance(error, one)), "")


def _begin(place: DirectoryPlace, request: Mapping[str, Any], _: bytes) -> Any:
    # A copy whose connection was cut holds the recording until its server notices.
    wants_payloads = bool(request["wants_payloads"])
    begun = place.begin(
        str(request["recording"]), wants_payloads=wants_payloads, wait_s=_IDLE_S + 10
    )
    return asdict(begun)


def _have(place: DirectoryPlace, request: Mapping[str, Any], _: bytes) -> Any:
    found = place.have([str(one) for one in request["recordings"]])
    return {one: asdict(copied) for one, copied in found.items()}


_ANSWERS: Final[Mapping[str, Callable[[DirectoryPlace, Mapping[str, Any], bytes], Any]]] = {
    "sees": lambda place, request, _: place.sees(str(request["mark"])),
    "have": _have,
    "segments": lambda place, request, _: place.segments(str(request["recording"])),
    "hold": lambda place, request, _: place.hold([str(one) for one in request["recordings"]]),
    "drop": lambda place, *_: place.drop(),
    "begin": _begin,
    "digest": lambda place, request, _: place.digest(
        CopiedFile.of(request["file"]), int(request["length"])
    ),
    "append": lambda place, request, body: place.append(
        CopiedFile.of(request["file"]), int(request["at"]), body
    ),
    "prove": lambda place, request, _: place.prove(CopiedFile.of(request["file"])),
    "publish": lambda place, _, body: place.publish(body),
    "problems": lambda place, request, _: place.problems(str(request["recording"])),
    "leave": lambda place, *_: place.leave(),
}
"""What is done for each request; KeyError, TypeError, ValueError for a malformed one."""


def _write(stream: IO[bytes], value: Mapping[str, Any], body: Buffer = b"") -> None:
    text = json.dumps(value).encode()
    stream.write(_HEAD.pack(len(text), len(body)) + text)
    stream.write(body)
    stream.flush()


def _read(stream: IO[bytes] | _Heard) -> tuple[dict[str, Any], bytes] | None:
    """The next frame; None at the end.

    Raises:
        ValueError: It is none, or too large.
    """
    head = _exactly(stream, _HEAD.size)
    if head is None:
        return None
    sizes = _HEAD.unpack(head)
    if sizes[0] > _MAX_VALUE or sizes[1] > _MAX_BODY:
        raise ValueError(f"it begins with {head!r}")
    text, body = (_exactly(stream, size) for size in sizes)
    if text is None or body is None:
        return None  # cut in the middle
    value = json.loads(text)
    if not isinstance(value, dict):
        raise ValueError("it is no JSON object")
    return value, body


def _exactly(stream: IO[bytes] | _Heard, size: int) -> bytes | None:
    """So many bytes; None if the stream ends before."""
    parts = []
    while size:
        part = stream.read(min(size, 1 << 20))
        if not part:
            return None
        parts.append(part)
        size -= len(part)
    return b"".join(parts)


def _mapping(value: object) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise StoreError("The other side answers what no copy answers.")
    return value


def _copied(value: object) -> Copied:
    found = _mapping(value)
    expired = found.get("expired")
    return Copied(
        _shown(found.get("name")),
        found.get("lacks_payloads") is True,
        expired if isinstance(expired, int) else 0,
        _shown(found.get("content")),
    )


def _shown(text: object) -> str:
    """A text of the other side, for people."""
    return "".join(one if one.isprintable() else "?" for one in str(text)[:_MAX_TEXT])
