"""MongoDB servers of our own on loopback: single ones and replica sets of three."""

from __future__ import annotations

import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from pymongo import MongoClient
from pymongo.errors import PyMongoError

from hybridlog_storage.mongo.mongod import find_mongod

_LIMIT_S = 60.0


def free_port() -> int:
    """A port of loopback that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def eventually(condition: Callable[[], Any], what: str) -> Any:
    """Wait until a condition holds; returns its value."""
    deadline = time.monotonic() + _LIMIT_S
    while True:
        try:
            if found := condition():
                return found
        except PyMongoError:
            pass
        assert time.monotonic() < deadline, what
        time.sleep(0.05)


class Mongod:
    """A mongod on a port of loopback.

    Args:
        directory: Of its data and log; created.
        options: Further options of mongod.
        port: Its port; None for a free one.
    """

    def __init__(self, directory: Path, *options: object, port: int | None = None) -> None:
        directory.mkdir(exist_ok=True)
        self.port = port or free_port()
        self.address = f"127.0.0.1:{self.port}"
        self._command = [
            str(find_mongod()),
            *("--dbpath", str(directory), "--logpath", str(directory / "log"), "--logappend"),
            *("--bind_ip", "127.0.0.1", "--port", str(self.port), "--nounixsocket"),
            *("--wiredTigerCacheSizeGB", "0.25", "--oplogSize", "50", "--noscripting", "--quiet"),
            *("--wiredTigerEngineConfigString", "log=(prealloc=false,file_max=10MB)"),
            *("--setParameter", "diagnosticDataCollectionEnabled=false"),
            *map(str, options),
        ]
        self._process: subprocess.Popen[bytes] | None = None
        self.start()

    def start(self) -> None:
        """Start it, unless it runs."""
        if self._process is None:
            self._process = subprocess.Popen(self._command, stdout=subprocess.DEVNULL)

    def signal(self, number: int) -> None:
        """Send it a signal, unless it is dead."""
        if self._process is not None:
            self._process.send_signal(number)

    def stop(self) -> None:
        """End it, after it has written what it acknowledged."""
        self.signal(signal.SIGTERM)
        if self._process is not None:
            self._process.wait()
        self._process = None

    def kill(self) -> None:
        """Kill it, unless it is dead."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        self._process = None

    def __enter__(self) -> Mongod:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()


class ReplicaSet:
    """Three mongods of which each may become the primary, within seconds."""

    def __init__(self, members: list[Mongod]) -> None:
        self.members = members
        hosts = ",".join(member.address for member in members)
        self._uri = f"mongodb://{hosts}/{{}}?replicaSet=set"
        config = {
            "_id": "set",
            "members": [{"_id": n, "host": m.address} for n, m in enumerate(members)],
            "settings": {"electionTimeoutMillis": 1000, "heartbeatIntervalMillis": 200},
        }
        with MongoClient[dict[str, Any]](
            f"mongodb://{members[0].address}/?directConnection=true"
        ) as c:
            eventually(lambda: c.admin.command("replSetInitiate", config), "no replica set")
        self.client = MongoClient[dict[str, Any]](self.uri("test"))
        self.heal()

    def uri(self, database: str, options: str = "") -> str:
        """URI of the set."""
        return self._uri.format(database) + options

    def heal(self) -> None:
        """Start what is dead, and wait until all are members again."""
        for member in self.members:
            member.start()

        def is_whole() -> bool:
            states = [
                m["stateStr"] for m in self.client.admin.command("replSetGetStatus")["members"]
            ]
            return sorted(states) == ["PRIMARY", "SECONDARY", "SECONDARY"]

        eventually(is_whole, "the replica set is not whole")

    @property
    def primary(self) -> Mongod:
        """The member that is the primary."""
        _, port = eventually(lambda: self.client.primary, "no primary")
        return next(member for member in self.members if member.port == port)

    def kill_primary(self) -> None:
        """Kill it with SIGKILL; the others elect another."""
        self.primary.kill()

    def stop_secondaries(self) -> Mongod:
        """Let the others than the primary hear nothing until `resume`; returns the primary."""
        primary = self.primary
        for member in self.members:
            if member is not primary:
                member.signal(signal.SIGSTOP)
        return primary

    def resume(self) -> None:
        """Let all that live go on."""
        for member in self.members:
            member.signal(signal.SIGCONT)


@contextmanager
def replica_set(directory: Path) -> Iterator[ReplicaSet]:
    """A replica set of three."""
    with ExitStack() as stack:
        members = [
            stack.enter_context(Mongod(directory / f"member{n}", "--replSet", "set"))
            for n in range(3)
        ]
        found = ReplicaSet(members)
        stack.callback(found.client.close)
        yield found
