"""The loop of `record --watch`, `copy --watch` and `index watch`."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest

from hybridlog.cli import watching
from hybridlog.cli.signals import Stopped, if_stopped
from hybridlog_storage.errors import (
    BucketError,
    DatabaseError,
    HybridlogError,
    StoreError,
    UsageError,
)

Round = list[HybridlogError]


def watched(
    rounds: list[Round], monkeypatch: pytest.MonkeyPatch, *, quiet: bool = False
) -> list[float]:
    """Watch something; the last problem of a round is raised if a place is away by it.

    Returns:
        The pauses; a signal comes in the one after the last round.
    """
    waiting, pauses = iter(rounds), list[float]()

    def look() -> Iterator[HybridlogError]:
        for problem in next(waiting):
            if isinstance(problem, StoreError):
                yield problem
            else:
                raise problem

    def pause(seconds: float) -> None:
        pauses.append(seconds)
        if len(pauses) == len(rounds):
            raise Stopped(signal.SIGTERM)

    monkeypatch.setattr(watching, "pause", pause)
    with if_stopped("All of it is safe."):
        watching.watch("the lab", look, pause_s=3, quiet=quiet)
    return pauses


def test_a_problem_is_told_once_as_long_as_it_lasts(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b = StoreError("a"), StoreError("b")
    assert watched([[a], [a, b], [], [b], [b]], monkeypatch) == [3] * 5
    first, *told, last = capsys.readouterr().err.splitlines()
    assert told == ["a", "b", "b"]
    assert (first, last) == ("Watching the lab. Ctrl-C ends it.", "All of it is safe.")


def test_what_is_away_is_tried_again_after_a_longer_pause(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    a = StoreError("a")
    away: list[Round] = [[DatabaseError("no MongoDB")], [a, DatabaseError("no MongoDB")]]
    pauses = watched([[a], *away, [a], [BucketError("no bucket")]], monkeypatch, quiet=True)
    assert pauses == [3, 15, 15, 3, 15]
    *told, _ = capsys.readouterr().err.splitlines()
    again = "The next try is in 15 s."
    assert told == ["a", "no MongoDB", again, "no bucket", again]


def test_a_wrong_option_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError, match="this very store"):
        watched([[UsageError("this very store")]], monkeypatch)
