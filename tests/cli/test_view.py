"""`hybridlog view` as a process."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from hybridlog_storage.disk.directory import StoreDirectory

from .running import environment, run


@pytest.fixture
def store(tmp_path: Path) -> Path:
    StoreDirectory.create(tmp_path / "store")
    return tmp_path / "store"


def start(*options: str | Path, folder: Path | None = None) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "hybridlog", "view", *map(str, options)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        bufsize=1,
        cwd=folder,
        env=environment(),
    )


def test_it_serves_until_it_is_stopped(store: Path) -> None:
    running = start("--store", store, "--json")
    assert running.stdout is not None
    said = json.loads("".join(iter(running.stdout.readline, "}\n")) + "}")
    with urllib.request.urlopen(said["url"] + "recordings") as answer:
        assert json.load(answer)["all"] == 0
    running.send_signal(signal.SIGTERM)
    _, errors = running.communicate(timeout=20)
    assert (running.returncode, errors) == (0, "")
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(said["url"])


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # of its socket
def test_what_is_refused_before_anything_is_served(store: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        taken = run("view", "--port", port, store=store, code=2)
    assert "is in use. Give another one with --port, or 0 for any." in taken.err
    unknown = run("view", "monday", store=store, code=2)
    assert (unknown.out, "monday" in unknown.err) == ("", True)
