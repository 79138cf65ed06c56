"""Other users of the system, to try permissions with: root is stopped by none.

The users need not exist. Tests with them run where root runs the tests, as in CI.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from tests.cli.within import Answer
from tests.imports import SOURCE_ROOTS

_LIMIT_S = 120
_SCRIPT = Path(__file__).with_name("as_user.py")

needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")


@dataclass(frozen=True)
class User:
    """A user, with a home and a folder for sockets.

    Attributes:
        place: A folder that everybody gets to; homes are made there.
        uid: Number.
        gid: Number of the first group.
        groups: Numbers of others.
        umask: What files are made with.
    """

    place: Path
    uid: int = 65534
    gid: int = 65534
    groups: tuple[int, ...] = field(default=())
    umask: int = 0o022

    @property
    def home(self) -> Path:
        return self.place / f"h{self.uid}"

    def python(self, *arguments: object, code: int | None = 0, **env: str) -> Answer:
        """Run Python, as this user, to its end."""
        if not self.home.exists():
            self.home.mkdir(mode=0o700)
            os.chown(self.home, self.uid, self.gid)
        trees = {sys.base_prefix, sys.prefix, *map(str, SOURCE_ROOTS)}
        job = {
            "uid": self.uid,
            "gid": self.gid,
            "groups": self.groups,
            "umask": self.umask,
            "trees": sorted(trees),
        }
        kept = {k: v for k, v in os.environ.items() if k not in {"HYBRIDLOG_STORE", "COLUMNS"}}
        home = str(self.home)
        ended = subprocess.run(
            [sys.executable, _SCRIPT, json.dumps(job), sys.executable, *map(str, arguments)],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            cwd="/",
            timeout=_LIMIT_S,
            check=False,
            env={
                **kept,
                "LC_ALL": "C.UTF-8",
                "PYTHONPATH": os.pathsep.join(map(str, SOURCE_ROOTS)),
                "HOME": home,
                "TMPDIR": home,
                "XDG_STATE_HOME": f"{home}/state",
                "HYBRIDLOG_RUNTIME_DIR": home,
                **env,
            },
        )
        done = Answer(ended.stdout.decode(), ended.stderr.decode(), ended.returncode, ended.stdout)
        if code is not None:
            assert done.code == code, (done.code, done.out[-2000:], done.err[-2000:])
        return done

    def run(self, *arguments: object, code: int | None = 0, **env: str) -> Answer:
        """Run a command of hybridlog's, as this user, to its end."""
        done = self.python("-m", "hybridlog", *arguments, code=code, **env)
        assert "Traceback" not in done.err, done.err
        return done


@contextmanager
def open_place() -> Iterator[Path]:
    """A folder that every user gets to, with a short path."""
    place = Path(tempfile.mkdtemp(prefix="hl-", dir="/tmp"))
    place.chmod(0o755)
    try:
        yield place
    finally:
        # A server that is just ending may still take files away, or make some.
        shutil.rmtree(place, ignore_errors=True)
        shutil.rmtree(place, ignore_errors=True)
