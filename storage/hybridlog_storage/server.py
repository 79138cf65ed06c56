"""A store on a server, as a place to copy to: OpenSSH's `ssh`, nothing to install there.

The login has a shell with `flock` and `sha256sum`, as Linux has them. So it is as in a directory:
the folder of the recording is locked meanwhile, a file goes on at the last byte that is there and
is proved there, and a manifest is replaced under its lock if it is unchanged.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import secrets
import shlex
import subprocess
import tempfile
from contextlib import ExitStack, contextmanager, suppress
from typing import IO, TYPE_CHECKING, Final, Self
from urllib.parse import unquote, urlsplit

from hybridlog_storage.copy import Place, Sending, folder_of
from hybridlog_storage.disk.directory import LOCK, LOCK_WAIT_S
from hybridlog_storage.errors import (
    ExistsError,
    HeldError,
    HybridlogError,
    ObjectChangedError,
    StoreError,
    UsageError,
)
from hybridlog_storage.manifest import MAX_BYTES, Manifest, encode
from hybridlog_storage.manifests import (
    MANIFEST_LOCK,
    MANIFEST_OLD,
    MANIFESTS,
    RECORDINGS,
    WAIT_S,
    Manifests,
)
from hybridlog_storage.settings import MAX_SETTINGS, StoreSettings, settings_of, settings_text
from hybridlog_storage.settings import NAME as SETTINGS
from hybridlog_storage.stopping import pause, safe_point

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator


DEFAULT_SSH: Final = "ssh -o ServerAliveInterval=15"
"""Notices within a minute that a connection is dead."""
_POLL_S: Final = 0.05
_NOT_REACHED: Final = 255  # exit code of ssh
_SILENT: Final = "it says nothing; the login needs a shell, with flock and sha256sum"
_SHARED_S: Final = 15  # a connection without users stays for so long
_SIZE: Final = re.compile("[0-9]{1,18}")
_MAX_SAID: Final = 80 << 20  # bytes that a script may print


class Server(Place):
    """A store on a server, `ssh://user@host:port/path`. A context manager.

    `/~/path` is below the home directory. `ssh` is the ssh program, with options; None for `ssh`.
    """

    def __init__(self, url: str, ssh: str | None = None) -> None:
        self.address = url
        self.manifests = _ServerManifests(self)
        self._host, options, self._root = _parts(url)
        self._ssh = [*shlex.split(ssh or DEFAULT_SSH), *options]
        self._held = ExitStack()

    def __enter__(self) -> Self:
        scratch = self._held.enter_context(tempfile.TemporaryDirectory(prefix="hl-"))
        # One login for all that follows.
        self._ssh += [
            *("-o", "ControlMaster=auto"),
            *("-o", f'ControlPath="{scratch}/login"'),
            *("-o", f"ControlPersist={_SHARED_S}"),
        ]
        self._held.callback(self._end)
        try:
            self.run("flock -w 9 . true && sha256sum < /dev/null")
        except BaseException:
            self._held.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._held.close()

    def _end(self) -> None:
        with suppress(OSError, subprocess.TimeoutExpired):
            words = [*self._ssh, "-O", "exit", self._host]
            subprocess.run(words, capture_output=True, check=False, timeout=10)  # noqa: S603

    @contextmanager
    def working(self, recording: str) -> Iterator[None]:
        """As of `Place`; the lock of the recording goes with the connection, too."""
        folder = folder_of(recording)
        locks = f"exec flock -w {LOCK_WAIT_S:.0f} {folder}/{LOCK} sh -c 'echo locked; cat'"
        with self._running(f"mkdir -p {folder} {MANIFESTS} && {locks}") as (process, said, errors):
            while not os.fstat(said.fileno()).st_size:
                if process.poll() is not None:
                    self._check_reached(process, errors)
                    if process.returncode != 1 or _reason(errors):
                        raise StoreError(f"{self.address}: {_reason(errors)}.")
                    raise HeldError(
                        f"Another process writes {recording} in {self.address} at this moment."
                    )
                pause(_POLL_S)
            yield

    def begin(self) -> None:
        """Make a store where there is none."""
        content = self.fetched(SETTINGS, MAX_SETTINGS)
        if content:
            settings_of(content, self.address)
            return
        if self.run("ls -A"):
            raise StoreError(
                f"{self.address} holds files and is not a hybridlog store. Choose an empty or a "
                "new directory."
            )
        new = settings_text(StoreSettings(secrets.token_hex(16)))
        self.run(f"cat > .{SETTINGS} && mv .{SETTINGS} {SETTINGS}", [new])

    def sizes(self, folder: str) -> dict[str, int]:
        """As of `Place`."""
        said = self.run(f"test ! -d {folder} || ls -lna {folder}").decode(errors="replace")
        rows = (row.split(maxsplit=8) for row in said.splitlines())
        return {
            row[8]: int(row[4])
            for row in rows
            if len(row) > 8 and row[0].startswith("-") and _SIZE.fullmatch(row[4])
        }

    def names(self) -> set[str]:
        """Names of all recordings."""
        pattern = r'^{"id":"[^"]*","name":"\([^"\]\|\\.\)*"'
        whole = f"find {MANIFESTS} -name '[!.]*.json'"  # others were left by a cut
        said = self.run(f"{whole} -exec grep -hao '{pattern}' {{}} + || true")
        return {json.loads(row + b"}")["name"] for row in said.splitlines()}

    def fetched(self, name: str, most: int) -> bytes:
        """A file, and at most one byte more than it may have; nothing if there is none."""
        return self.run(f"test ! -e {name} || head -c {most + 1} {name}")

    def _grow(self, sent: Sending, at: int) -> None:
        self.run(f"cat {'>>' if at else '>'} {shlex.quote(sent.part)}", sent.pieces(at))

    def _publish(self, sent: Sending) -> None:
        self.run(f"mv -f {shlex.quote(sent.part)} {shlex.quote(sent.name)}")

    def has(self, name: str, sent: Sending) -> bool:
        """As of `Place`; what is damaged here proves nothing, and raises `RefusedError`."""
        path = shlex.quote(name)
        said = self.run(f"sync {path} && sha256sum < {path} || true")
        return said[:64] == sent.sha256().encode()

    def drop(self, name: str) -> None:
        """As of `Place`."""
        self.run(f"rm -f {shlex.quote(name)}")

    def run(self, script: str, given: Iterable[bytes] = ()) -> bytes:
        """What a script prints that runs in the folder of the store, and is given some bytes."""
        with self._running(script) as (process, said, errors):
            assert process.stdin is not None
            with suppress(BrokenPipeError), process.stdin as stream:
                for piece in given:
                    safe_point()
                    stream.write(piece)
            while process.poll() is None:
                safe_point()
                with suppress(subprocess.TimeoutExpired):
                    process.wait(_POLL_S)
                if os.fstat(said.fileno()).st_size > _MAX_SAID:
                    raise StoreError(f"{self.address} says more than any store has to say.")
            self._check_reached(process, errors)
            if process.returncode:
                raise StoreError(f"{self.address}: {_reason(errors) or _SILENT}.")
            said.seek(0)
            return said.read()

    @contextmanager
    def _running(self, script: str) -> Iterator[_Running]:
        """A script in the folder of the store; it has ended at the end of the block."""
        root = shlex.quote(self._root)
        script = f"mkdir -- {root} 2> /dev/null; cd -- {root} || exit 2; {script}"
        words = [*self._ssh, self._host, f"env LC_ALL=C sh -c {shlex.quote(script)}"]
        with tempfile.TemporaryFile() as said, tempfile.TemporaryFile() as errors:
            try:
                process = subprocess.Popen(  # noqa: S603 - the user named it
                    words, stdin=subprocess.PIPE, stdout=said, stderr=errors
                )
            except OSError as error:
                raise StoreError(f"{words[0]} cannot be started: {error.strerror}.") from error
            with process:
                try:
                    yield process, said, errors
                except BaseException:
                    process.kill()
                    raise

    def _check_reached(self, process: subprocess.Popen[bytes], errors: IO[bytes]) -> None:
        if process.returncode not in range(_NOT_REACHED):  # or the connection's end has ended it
            raise StoreError(
                f"{self.address} is not reached: {_reason(errors) or _SILENT}. What arrived stays "
                "there: run the command again."
            )


class _ServerManifests(Manifests):
    """The manifests of a store on a server."""

    def __init__(self, server: Server) -> None:
        self.place, self._server = server.address, server

    def _create(self, manifest: Manifest) -> None:
        exists = ExistsError(f"There is a recording {manifest.id} already.")
        self._put(manifest.id, encode(manifest), "", exists)

    def _get(self, recording: str) -> tuple[bytes, str]:
        data = self._server.fetched(f"{MANIFESTS}/{recording}.json", MAX_BYTES)
        if not data:
            raise FileNotFoundError
        return data, hashlib.sha256(data).hexdigest()

    def _replace(self, recording: str, data: bytes, version: str) -> None:
        changed = ObjectChangedError(f"{self._server.address}: {recording} was changed meanwhile.")
        self._put(recording, data, version, changed)

    def _put(self, recording: str, data: bytes, version: str, changed: HybridlogError) -> None:
        """Write a manifest if the one there has a version still; none if that is empty.

        It is renamed under a lock; names of files are on the disk before and after.
        """
        folder, final = f"{RECORDINGS}/{recording}", f"{MANIFESTS}/{recording}.json"
        new = f"{MANIFESTS}/.new-{secrets.token_hex(8)}"
        lock = f"{folder}/{MANIFEST_LOCK}" if version else f"{MANIFESTS}/.lock"
        sync = f"{{ sync {folder} {RECORDINGS} {MANIFESTS} || sync; }}"
        is_same = f'test "$(sha256sum 2> /dev/null < {final})" = "{version and version + "  -"}"'
        script = (
            f"{sync} && {{ {is_same} || {{ echo changed; exit; }}; "
            f": >> {folder}/{MANIFEST_LOCK}; ln -f {final} {folder}/{MANIFEST_OLD} 2> /dev/null; "
            f"mv {new} {final}; }} && {sync}"
        )
        why = f"{lock} is held by another process, or cannot be written"
        locked = f"flock -w {WAIT_S:.0f} {lock} sh -c {shlex.quote(script)}"
        ends = f"|| {{ echo '{why}' >&2; false; }}; code=$?; rm -f {new}; exit $code"
        if self._server.run(f"cat > {new} && {locked} {ends}", [data]):
            raise changed


_Running = tuple["subprocess.Popen[bytes]", "IO[bytes]", "IO[bytes]"]
"""A process, and files with its output and its errors: pipes would stay open with the login."""


def _reason(errors: IO[bytes]) -> str:
    """The last lines of what a program has to complain about."""
    errors.seek(0)
    text = errors.read(_MAX_SAID).decode(errors="replace")
    shown = [line.strip() for line in text.splitlines() if line.strip()][-2:]
    return "".join(one for one in "; ".join(shown).rstrip(".") if one.isprintable())[:500]


def _parts(url: str) -> tuple[str, list[str], str]:
    """Host, options of the programs, and path of a URL."""
    try:
        parts = urlsplit(url)
        port, host = parts.port, parts.hostname or ""
    except ValueError as error:
        raise UsageError(f"{url!r} is no URL: {error}.") from error
    user, path = unquote(parts.username or ""), unquote(parts.path).removeprefix("/~/")
    if not host or host.startswith("-") or user.startswith("-") or not path.strip("/"):
        raise UsageError(f"Write ssh://user@host/path, not {url!r}.")
    if parts.password or parts.query or parts.fragment or not (url + path).isprintable():
        raise UsageError("ssh://user@host/path has no password; ssh asks, or takes a key.")
    options = [] if port is None else ["-o", f"Port={port}"]
    return f"{user}@{host}" if user else host, options, path
