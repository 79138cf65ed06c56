"""A store on a server, as a place to copy to: OpenSSH's own programs, nothing to install there.

`sftp` brings files, and goes on at the last byte that is there. If a shell with `flock` and
`sha256sum` answers, it is as in a directory: the folder of the recording is locked meanwhile,
what has arrived is proved there, and a manifest is replaced under its lock if it is unchanged.

Where only sftp is allowed, what has arrived is read back, and there are no locks: an edit by a
program on the server, or by another copy, between the last look at a manifest and its replacement
is lost.
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
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Final, Self
from urllib.parse import unquote, urlsplit

from hybridlog_storage.copy_places import (
    MARK,
    Place,
    RefusedError,
    read,
)
from hybridlog_storage.disk.directory import LOCK, LOCK_WAIT_S
from hybridlog_storage.errors import (
    HeldError,
    HybridlogError,
    ObjectChangedError,
    RecordingExistsError,
    StoreError,
    UsageError,
)
from hybridlog_storage.manifest import MAX_BYTES, Manifest, encode, hasher
from hybridlog_storage.manifests import (
    MANIFEST_LOCK,
    MANIFEST_OLD,
    MANIFESTS,
    RECORDINGS,
    WAIT_S,
    Manifests,
    ids_of,
)
from hybridlog_storage.settings import MAX_SETTINGS, StoreSettings, settings_of, settings_text
from hybridlog_storage.settings import NAME as SETTINGS
from hybridlog_storage.stopping import pause, safe_point

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from contextlib import AbstractContextManager

    from hybridlog_storage.copy_places import Sending

DEFAULT_SSH: Final = "ssh -o ServerAliveInterval=15"
"""Notices within a minute that a connection is dead."""
_POLL_S: Final = 0.05
_NOT_REACHED: Final = 255  # exit code of ssh
_CHANGED: Final = 9  # exit code of our scripts
_SHARED_S: Final = 15  # a connection without users stays for so long
_SIZE: Final = re.compile("[0-9]{1,18}")
_MAX_SAID: Final = 64 << 20  # bytes that a program may print
_LOOK: Final = "flock -w 9 . true && sha256sum < /dev/null > /dev/null && echo hybridlog"


class Server(Place):
    """A store on a server, `ssh://user@host:port/path`. A context manager.

    `/~/path` is below the home directory. `ssh` is the ssh program, with options; None for `ssh`.
    `has_shell` says that the server runs the programs that give a directory's promises.
    """

    mends = False

    def __init__(self, url: str, ssh: str | None = None) -> None:
        self.address = url
        self.manifests = _ServerManifests(self)
        self._ssh = shlex.split(ssh or DEFAULT_SSH)
        self._host, self._options, self._root = _parts(url)
        self._held = ExitStack()
        self._scratch = Path()
        self._found: dict[str, int] = {}  # by name, of the folder that was listed last
        self.has_shell = False

    def __enter__(self) -> Self:
        self._scratch = Path(self._held.enter_context(tempfile.TemporaryDirectory(prefix="hl-")))
        # One login for all that follows.
        self._options += [
            *("-o", "ControlMaster=auto"),
            *("-o", f'ControlPath="{self._scratch}/login"'),
            *("-o", f"ControlPersist={_SHARED_S}"),
        ]
        program = self._scratch / "ssh"
        program.write_text(f'#!/bin/sh\nexec {shlex.join(self._ssh)} "$@"\n')
        program.chmod(0o700)
        self._held.callback(self._end)
        try:
            self.sftp()
            with suppress(StoreError):  # ssh says the same if there is none
                self.has_shell = self.shell(_LOOK)[1].endswith("hybridlog\n")
        except BaseException:
            self._held.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._held.close()

    def _end(self) -> None:
        with suppress(OSError, subprocess.TimeoutExpired):
            words = [*self._ssh, *self._options, "-O", "exit", self._host]
            subprocess.run(words, capture_output=True, check=False, timeout=10)  # noqa: S603

    @contextmanager
    def working(self, recording: str) -> Iterator[None]:
        """As of `Place`; with a shell, as of a directory there."""
        folders = RECORDINGS, MANIFESTS, f"{RECORDINGS}/{recording}"
        self.sftp(*(f"-mkdir {folder}" for folder in folders))
        with self._locked(recording) if self.has_shell else nullcontext():
            yield

    @contextmanager
    def _locked(self, recording: str) -> Iterator[None]:
        """Hold the lock of a recording; it goes with the connection, too."""
        lock = f"{RECORDINGS}/{recording}/{LOCK}"
        script = f"exec flock -w {LOCK_WAIT_S:.0f} {lock} sh -c 'echo locked; cat'"
        with self._ssh_process(script) as (process, said, errors):
            while not os.fstat(said.fileno()).st_size:
                if process.poll() is not None:
                    self._check_reached(process, errors)
                    if process.returncode != 1:
                        raise StoreError(f"{self.address}: {_reason(errors)}.")
                    raise HeldError(
                        f"Another process writes {recording} in {self.address} at this moment.",
                        is_recording=False,
                    )
                pause(_POLL_S)
            yield

    def begin(self) -> None:
        """Make a store where there is none."""
        content = self.fetched(SETTINGS, MAX_SETTINGS)
        if content is not None:
            settings_of(content, self.address)
            return
        if [row for row in self.sftp("-ls -1a") if row not in {".", ".."}]:
            raise StoreError(
                f"{self.address} holds files and is not a hybridlog store. Choose an empty or a "
                "new directory."
            )
        new = StoreSettings(secrets.token_hex(16))
        self.move(self.put_beside(settings_text(new), "."), SETTINGS)

    def sees(self, name: str) -> bool:
        """As of `Place`."""
        return f"{MANIFESTS}/{name}" in self.listed(f"{MANIFESTS}/{name}")

    def sizes(self, recording: str) -> dict[str, int]:
        """As of `Place`."""
        folder = f"{RECORDINGS}/{recording}"
        found = self.listed(folder)
        self._found = {name.removeprefix(f"{folder}/"): size for name, size in found.items()}
        return self._found

    def listed(self, path: str) -> dict[str, int]:
        """Bytes of ordinary files by name, of a folder or by a pattern."""
        rows = (row.split(maxsplit=8) for row in self.sftp(f"-ls -lna {path}"))
        return {
            row[8]: int(row[4])
            for row in rows
            if len(row) > 8 and row[0].startswith("-") and _SIZE.fullmatch(row[4])
        }

    def names(self) -> set[str]:
        """Names of all recordings."""
        if self.has_shell:
            pattern = r'^{"id":"[^"]*","name":"\([^"\]\|\\.\)*"'
            whole = f"find {MANIFESTS} -name '[!.]*.json'"  # others were left by a cut
            _, said = self.shell(f"{whole} -exec grep -hao '{pattern}' {{}} + || true")
            return {json.loads(f"{row}}}")["name"] for row in said.splitlines()}
        return {one.name for one in self.manifests.each(self.manifests.ids())}

    def put_beside(self, content: bytes, folder: str) -> str:
        """Write a small file under a hidden name of its own."""
        name = f"{folder}/{MARK}{secrets.token_hex(8)}"
        self.put(content, name)
        return name

    def put(self, content: bytes, name: str) -> None:
        """Write a small file."""
        with tempfile.TemporaryFile() as file:
            os.fchmod(file.fileno(), 0o666)  # which it has there, less the umask
            file.write(content)
            file.flush()
            self.sftp(f"put -f {_handle(file.fileno())} {name}", passed=file.fileno())

    def move(self, old: str, new: str) -> None:
        """Rename a file; it takes the place of another one."""
        self.sftp(f"rename {_quoted(old)} {_quoted(new)}")

    def fetched(self, name: str, most: int) -> bytes | None:
        """A file, and at most one byte more than it may have; None if there is none."""
        with self._got(name, most) as path:
            if path.exists():
                return path.read_bytes()[: most + 1]
        if self.listed(name):
            raise StoreError(f"{self.address}/{name} cannot be read.")
        return None

    @contextmanager
    def _got(self, name: str, most: int) -> Iterator[Path]:
        """A file that was fetched, if it is there; one with more bytes, not to its end."""
        path = self._scratch / secrets.token_hex(8)
        try:
            with suppress(_EnoughError):
                line = f'-get {_quoted(name)} "{path}"'
                self.sftp(line, watch=lambda _: _check_size(path, most))
            yield path
        finally:
            path.unlink(missing_ok=True)

    def send(self, sent: Sending) -> None:
        """As of `Place`; goes on at the last byte that is there."""
        name, part = sent.name, sent.part
        with sent.source.opened(name, sent.size) as fd:
            sha256, digest = _digests(fd)
            if digest != sent.digest:
                raise sent.damaged()
            there = self._found.pop(part.rpartition("/")[2], 0)
            for at in sent.begins(there):
                sent.count(at, False)
                if at < sent.size or not at:
                    self._send(fd, part, at, sent)
                if self._is(part, sha256, sent):
                    self.move(part, name)
                    return
        self.drop(part)
        raise sent.not_arrived(self)

    def _send(self, fd: int, part: str, at: int, sent: Sending) -> None:
        done = at

        def watch(process: int) -> None:
            nonlocal done
            now = max(done, min(_position(process, fd), sent.size))
            sent.count(now - done, True)
            done = now

        how = "reput" if at else "put"
        limit = [] if sent.limit_rate is None else ["-l", str(max(int(sent.limit_rate / 128), 1))]
        self.sftp(f"{how} -f {_handle(fd)} {part}", passed=fd, watch=watch, options=limit)
        sent.count(sent.size - done, True)

    def drop(self, name: str) -> None:
        """As of `Place`."""
        self.sftp(f"-rm {_quoted(name)}")

    def is_whole(self, sent: Sending, *, reads: bool = False) -> bool:
        """As of `Place`."""
        sha256 = ""
        if self.has_shell:
            with suppress(RefusedError), sent.source.opened(sent.name, sent.size) as fd:
                found, digest = _digests(fd)
                sha256 = found if digest == sent.digest else ""
        return self._is(sent.name, sha256, sent)

    def _is(self, name: str, sha256: str, sent: Sending) -> bool:
        """True if a file there has the bytes of one here, whose SHA-256 may be known."""
        if self.has_shell:
            path = shlex.quote(name)
            code, said = self.shell(f"sha256sum < {path} && sync {path}")
            if sha256 or code:
                return code == 0 and said.split()[:1] == [sha256]
        with suppress(FileNotFoundError), self._got(name, sent.size) as got, got.open("rb") as file:
            return _digests(file.fileno())[1] == sent.digest
        return False

    def sftp(
        self,
        *lines: str,
        passed: int | None = None,
        watch: Callable[[int], None] = lambda _: None,
        options: Sequence[str] = (),
    ) -> list[str]:
        """Run commands in the folder of the store; what they print.

        Lines that begin with `-` may fail. `passed` is a handle that a command reads. `watch` is
        called now and then with the id of the process; what it raises ends that.
        """
        root = self._root.replace("\\", "\\\\").replace('"', '\\"')
        silent = [f"-@{line[1:]}" if line.startswith("-") else f"@{line}" for line in lines]
        script = "\n".join([f'-@mkdir "{root}"', f'@cd "{root}"', *silent, ""])
        host = self._host
        if ":" in host:
            user, at, host = host.rpartition("@")
            host = f"{user}{at}[{host}]"
        words = [
            *("sftp", "-q", "-S", str(self._scratch / "ssh"), *self._options),
            *("-o", "BatchMode=no", "-b", "-", *options, host),
        ]
        code, said, why = self._run(_running(words, passed), script, watch)
        if code:
            hint = " Is there room?" if "Failure" in why else ""  # all that sftp says of it
            raise StoreError(f"{self.address}: {why}.{hint}")
        return said.splitlines()

    def shell(self, script: str) -> tuple[int, str]:
        """Exit code and output of a script that runs in the folder of the store."""
        return self._run(self._ssh_process(script))[:2]

    def _run(
        self,
        running: AbstractContextManager[_Running],
        given: str = "",
        watch: Callable[[int], None] = lambda _: None,
    ) -> tuple[int, str, str]:
        """Exit code, output and complaints of a program."""
        with running as (process, said, errors):
            assert process.stdin is not None
            with suppress(BrokenPipeError), process.stdin as stream:
                stream.write(given.encode())
            while True:
                with suppress(subprocess.TimeoutExpired):
                    process.wait(_POLL_S)
                    break
                safe_point()
                watch(process.pid)
                if os.fstat(said.fileno()).st_size > _MAX_SAID:
                    raise StoreError(f"{self.address} says more than any store has to say.")
            self._check_reached(process, errors)
            return process.returncode, _text(said), _reason(errors)

    def _ssh_process(self, script: str) -> AbstractContextManager[_Running]:
        script = f"cd -- {shlex.quote(self._root)} && {script}"
        command = f"sh -c {shlex.quote(script)}"
        return _running([*self._ssh, *self._options, self._host, command], None)

    def _check_reached(self, process: subprocess.Popen[bytes], errors: IO[bytes]) -> None:
        if process.returncode not in range(_NOT_REACHED):  # or the connection's end has ended it
            raise StoreError(
                f"{self.address} is not reached: {_reason(errors)}. What arrived stays there: run "
                "the command again."
            )


class _ServerManifests(Manifests):
    """The manifests of a store on a server."""

    def __init__(self, server: Server) -> None:
        self.place, self._server = server.address, server

    def ids(self) -> list[str]:
        """Ids of all recordings that have a manifest, sorted."""
        return ids_of(Path(name).name for name in self._server.listed(MANIFESTS))

    def _create(self, manifest: Manifest) -> None:
        exists = RecordingExistsError(f"There is a recording {manifest.id} already.")
        self._put(manifest.id, encode(manifest), "", exists)

    def _get(self, recording: str) -> tuple[bytes, str]:
        data = self._server.fetched(_path(recording), MAX_BYTES)
        if data is None:
            raise FileNotFoundError
        return data, hashlib.sha256(data).hexdigest()

    def _replace(self, recording: str, data: bytes, version: str) -> None:
        changed = ObjectChangedError(f"{self._server.address}: {recording} was changed meanwhile.")
        self._put(recording, data, version, changed)

    def _put(self, recording: str, data: bytes, version: str, changed: HybridlogError) -> None:
        """Write a manifest if the one there has a version still; none if that is empty."""
        server = self._server
        new = server.put_beside(data, MANIFESTS)  # until it is renamed
        try:
            if server.has_shell:
                self._put_by_shell(recording, new, version, changed)
                return
            now = ""
            with suppress(FileNotFoundError):
                now = self._get(recording)[1]
            if now != version:
                raise changed
            if not version:
                server.put(b"", f"{RECORDINGS}/{recording}/{MANIFEST_LOCK}")
            server.move(new, _path(recording))
        except BaseException:
            with suppress(StoreError):
                server.drop(new)
            raise

    def _put_by_shell(
        self, recording: str, new: str, version: str, changed: HybridlogError
    ) -> None:
        """Rename a manifest there under a lock; names of files are on the disk before and after."""
        folder, final, address = f"{RECORDINGS}/{recording}", _path(recording), self._server.address
        lock = f"{folder}/{MANIFEST_LOCK}" if version else f"{MANIFESTS}/.lock"
        sync = f"{{ sync {folder} {RECORDINGS} {MANIFESTS} || sync; }}"
        is_same = f'test "$(sha256sum 2> /dev/null < {final})" = "{version and version + "  -"}"'
        script = (
            f"{sync} && {{ {is_same} || exit {_CHANGED}; : >> {folder}/{MANIFEST_LOCK}; "
            f"ln -f {final} {folder}/{MANIFEST_OLD} 2> /dev/null; "
            f"mv {new} {final}; }} && {sync}"
        )
        code, said = self._server.shell(
            f"exec flock -w {WAIT_S:.0f} {lock} sh -c {shlex.quote(script)} 2>&1"
        )
        if code == _CHANGED:
            raise changed
        if code:
            raise StoreError(
                f"{address}: a manifest cannot be written ({said.strip()[:500]}), or another "
                f"process has held {lock} for {WAIT_S:.0f} s."
            )

    def _drop(self, recording: str) -> None:
        raise StoreError(f"Recordings of {self._server.address} can only be removed there.")

    _delete_files = _drop

    def _forget(self, recording: str, *, says_so: bool) -> None:
        self._drop(recording)


_Running = tuple["subprocess.Popen[bytes]", "IO[bytes]", "IO[bytes]"]
"""A process, and files with its output and its errors: pipes would stay open with the login."""


@contextmanager
def _running(words: Sequence[str], passed: int | None) -> Iterator[_Running]:
    """A process; it has ended at the end of the block."""
    with tempfile.TemporaryFile() as said, tempfile.TemporaryFile() as errors:
        try:
            process = subprocess.Popen(  # noqa: S603 - the user named it
                words,
                stdin=subprocess.PIPE,
                stdout=said,
                stderr=errors,
                pass_fds=[] if passed is None else [passed],
                env={**os.environ, "LC_ALL": "C"},
            )
        except OSError as error:
            raise StoreError(f"{words[0]} cannot be started: {error.strerror}.") from error
        with process:
            try:
                yield process, said, errors
            except BaseException:
                process.kill()
                raise


class _EnoughError(Exception):
    """A file is larger than it may be."""


def _check_size(path: Path, most: int) -> None:
    with suppress(FileNotFoundError):
        if path.stat().st_size > most:
            raise _EnoughError


def _text(file: IO[bytes]) -> str:
    """The output of a program."""
    file.seek(0)
    return file.read(_MAX_SAID).decode(errors="replace")


def _reason(errors: IO[bytes]) -> str:
    """The last lines of what a program has to complain about."""
    lines = [line.strip() for line in _text(errors).splitlines()]
    shown = [line for line in lines if line and not line.startswith("remote mkdir")][-2:]
    return "".join(one for one in "; ".join(shown).rstrip(".") if one.isprintable())[:500]


def _quoted(name: str) -> str:
    """A path below the store, as commands of sftp take it; `RefusedError` if they cannot."""
    if not name.isprintable():
        raise RefusedError(f"sftp cannot send {name!r}: it has odd characters in its name.")
    escaped = re.sub(r'(["\\\\])', r"\\\1", name)
    return f'"{escaped}"'


def _path(recording: str) -> str:
    return f"{MANIFESTS}/{recording}.json"


def _handle(fd: int) -> str:
    """A name for an open file, which no other one can take."""
    os.lseek(fd, 0, os.SEEK_SET)  # some systems give the same place in it
    return f"/dev/fd/{fd}"


def _position(process: int, fd: int) -> int:
    """The bytes that a process has read of an open file, if the system says."""
    folder, found = Path(f"/proc/{process}"), 0
    with suppress(OSError, ValueError):
        for one in (folder / "fd").iterdir():
            is_it = one.name != str(fd) and os.path.samestat(one.stat(), os.fstat(fd))
            if is_it:
                text = (folder / "fdinfo" / one.name).read_text()
                found = int(text.split()[1])
    return found


def _digests(fd: int) -> tuple[str, str]:
    """SHA-256, which servers can work out, and the digest of an open file."""
    sha256, digest = hashlib.sha256(), hasher()
    for piece in read(fd, 0, os.fstat(fd).st_size):
        safe_point()
        sha256.update(piece)
        digest.update(piece)
    return sha256.hexdigest(), digest.hexdigest()


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
