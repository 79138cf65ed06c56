"""Runs commands in this process, for tests that are about their answers alone."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

from click import ClickException
from click.testing import CliRunner

from hybridlog.cli.app import app
from hybridlog_storage.errors import HybridlogError


class Answer(NamedTuple):
    """What a command has printed."""

    out: str
    err: str
    code: int = 0
    raw: bytes = b""

    @property
    def json(self) -> Any:
        return json.loads(self.out)

    @property
    def lines(self) -> list[str]:
        return self.out.splitlines()


def answer(*arguments: object, store: Path, code: int | None = 0) -> Answer:
    """Run a command to its end; much faster than `run`, which starts a process.

    The message of an error ends what was said on standard error.

    Args:
        arguments: Of the command.
        store: What HYBRIDLOG_STORE says.
        code: The exit code that is expected; None for any.
    """
    environment = {"HYBRIDLOG_STORE": str(store)}
    done = CliRunner().invoke(app, [*map(str, arguments)], env=environment, standalone_mode=False)
    error = done.exception
    if error is not None and not isinstance(error, HybridlogError | ClickException):
        raise error
    found = done.exit_code if error is None else error.exit_code
    assert code in {None, found}, (error, done.output)
    said = error.format_message() if isinstance(error, ClickException) else str(error or "")
    return Answer(done.stdout, done.stderr + said, found, done.stdout_bytes)
