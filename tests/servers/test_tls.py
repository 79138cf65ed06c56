"""A MongoDB with TLS, user and password, as commands meet it."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
from pymongo import MongoClient

import hybridlog as hl
from hybridlog_storage.messages import Channel, Schema
from tests import logs
from tests.cli.running import COMMAND, environment, run
from tests.indexed import misindexed
from tests.servers.mongods import Mongod, eventually, free_port

pytestmark = pytest.mark.mongo("embedded")

PASSWORD = "s3cret/pä:ss@word"
MESSAGES = 300
NUMBERS = count()


@dataclass(frozen=True)
class Guarded:
    """A server with TLS and login."""

    port: int
    authority: Path
    other_authority: Path

    def uri(self, *, user: str = "robot@", options: str | None = None) -> str:
        """URI of a new database."""
        tls = f"tls=true&tlsCAFile={quote(str(self.authority), safe='/')}"
        chosen = tls if options is None else options
        return (
            f"mongodb://{user}127.0.0.1:{self.port}/robots{next(NUMBERS)}"
            f"?authSource=admin&serverSelectionTimeoutMS=1500&{chosen}"
        )


def openssl(*arguments: object) -> None:
    subprocess.run(["openssl", *map(str, arguments)], check=True, capture_output=True)


def authority(place: Path) -> Path:
    """A certificate authority of our own; its key lies beside it."""
    openssl(
        *("req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"),
        *("-keyout", place.with_suffix(".key"), "-out", place, "-days", 2),
        *("-subj", f"/CN={place.stem}"),
    )
    return place


def certificate(place: Path, signer: Path) -> Path:
    """Certificate and key of a server on loopback, in one file."""
    request, key, extra = (place.with_suffix(end) for end in (".csr", ".key", ".ext"))
    extra.write_text("subjectAltName=IP:127.0.0.1\n")
    openssl(
        *("req", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"),
        *("-keyout", key, "-out", request, "-subj", "/CN=server"),
    )
    openssl(
        *("x509", "-req", "-in", request, "-CA", signer, "-CAkey", signer.with_suffix(".key")),
        *("-CAcreateserial", "-out", place, "-days", 2, "-extfile", extra),
    )
    place.write_bytes(place.read_bytes() + key.read_bytes())
    return place


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guarded]:
    place = tmp_path_factory.mktemp("tls")
    ours, others = authority(place / "ours.pem"), authority(place / "others.pem")
    identity = certificate(place / "server.pem", ours)
    port = free_port()
    with Mongod(
        place / "data",
        *("--auth", "--tlsMode", "requireTLS", "--tlsCertificateKeyFile", identity),
        *("--tlsCAFile", ours, "--tlsAllowConnectionsWithoutCertificates"),
        port=port,
    ):
        first = f"mongodb://127.0.0.1:{port}/?tls=true&tlsCAFile={ours}"
        with MongoClient[dict[str, Any]](first) as client:
            make = partial(client.admin.command, "createUser", pwd=PASSWORD)
            eventually(lambda: make("admin", roles=["root"]), "no server with TLS")
        with MongoClient[dict[str, Any]](first, username="admin", password=PASSWORD) as client:
            # What the documentation says is enough.
            roles = [{"role": "readWrite", "db": f"robots{n}"} for n in range(20)]
            client.admin.command("createUser", "robot", pwd=PASSWORD, roles=roles)
        yield Guarded(port, ours, others)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return logs.write(tmp_path / "a.mcap", logs.content(0, MESSAGES))


def test_everything_works_and_the_password_stays_where_it_is(
    server: Guarded, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, uri = tmp_path / "store", server.uri()
    env = {"HYBRIDLOG_MONGO_PASSWORD": PASSWORD, "HYBRIDLOG_MONGO_URI": uri}
    said = [run("record", log, store=store, **env)]
    where = ("fetch", "-t", "/number", "--where", "n >= 100")
    counted = run(*where, "--count", "--quiet", store=store, **env)
    assert counted.out.split() == [str(MESSAGES - 100)]
    rows = run(*where, "--format", "jsonl", "--quiet", store=store, **env)
    assert len(rows.lines) == MESSAGES - 100
    indexed = run("index", "add", "/number", "n", store=store, **env)
    verified = run("verify", store=store, **env)
    again = run("index", "rebuild", store=store, **env)
    said += [counted, rows, indexed, verified, again, run("verify", store=store, **env)]
    monkeypatch.setenv("HYBRIDLOG_MONGO_PASSWORD", PASSWORD)
    channel = Channel("/live", "ros1", Schema("a/N", "ros1msg", b"uint32 n\n"), {}, False)
    with hl.open(store, mongo=uri, require_database=True) as opened:
        recording = opened.start("live")
        for n in range(100):
            recording.write(channel, n.to_bytes(4, "little"))
        assert recording.close().failure is None
        assert opened.topic("/live").where({"n": {"$gte": 40}}).count() == 60
        assert misindexed(opened) == {}
    parts = (PASSWORD, quote(PASSWORD, safe=""), "s3cret")
    for done in said:
        assert not any(part in done.out + done.err for part in parts)
    for path in (p for p in store.rglob("*") if p.is_file()):
        assert not any(part.encode() in path.read_bytes() for part in parts), path


def test_other_users_do_not_see_the_password(server: Guarded, log: Path, tmp_path: Path) -> None:
    """While a command runs: in the arguments of all processes, and in what they do not hide."""
    seen = set[bytes]()
    words = ("record", log, "--mongo", server.uri(), "--store", tmp_path / "store")
    process = subprocess.Popen(
        [*COMMAND, *map(str, words)],
        env=environment(HYBRIDLOG_MONGO_PASSWORD=PASSWORD),
        stdout=subprocess.DEVNULL,
    )
    while process.poll() is None:
        for one in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                seen.add((one / "cmdline").read_bytes())
    assert process.returncode == 0
    assert any(b"record\0" in line and str(server.port).encode() in line for line in seen)
    assert not any(b"s3cret" in line for line in seen)


@pytest.mark.parametrize(
    ("user", "password", "options", "cure"),
    [
        ("robot@", "wrong", None, "HYBRIDLOG_MONGO_PASSWORD"),
        ("robot@", "", None, "HYBRIDLOG_MONGO_PASSWORD"),
        ("", "", None, "mongodb://USER@"),
        ("robot@", PASSWORD, "tls=true&tlsCAFile={other}", "certificate"),
        ("robot@", PASSWORD, "tls=true&tlsCAFile=/nowhere.pem", "/nowhere.pem"),
        ("robot@", PASSWORD, "tls=false", "does not answer"),
    ],
)
def test_what_is_wrong_is_said_with_its_cure(
    server: Guarded,
    log: Path,
    tmp_path: Path,
    user: str,
    password: str,
    options: str | None,
    cure: str,
) -> None:
    given = None if options is None else options.format(other=server.other_authority)
    uri = server.uri(user=user, options=given)
    env = {"HYBRIDLOG_MONGO_PASSWORD": password}
    done = run("record", log, "--mongo", uri, "-q", store=tmp_path / "store", code=None, **env)
    assert done.code not in {0, 1}
    assert cure in done.err
    assert "s3cret" not in done.err
    assert "_ssl.c" not in done.err
    assert len(done.err.strip().splitlines()) == 1
