"""Backends filled and asked, each in a process of its own, and samples made of the answers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

from benchmarks.harness.run import Outcome
from benchmarks.samples import Sample
from benchmarks.side import SideError, run_side, spelled, warm_cache
from benchmarks.studies.runs import Context, run_directory

if TYPE_CHECKING:
    from benchmarks.backends.base import Backend
    from benchmarks.loads.base import Load

_TIMEOUT_S = 900.0
"""A side is ended after it."""


def turns(
    context: Context, side: Literal["ask", "read"], load: Load, repetitions: int
) -> Iterator[tuple[str, Outcome, dict[str, Any]]]:
    """Every backend's turn: its name, how it ended, and its results by question or task.

    Args:
        context: Where and how.
        side: Function of `benchmarks.questions.sides`.
        load: What it is filled with.
        repetitions: Of each question.
    """
    for name, kind in context.backends.items():
        asker = kind.asker if side == "ask" else kind.reader
        if not asker:
            continue
        reason = context.missing.get(name)
        if reason is not None:
            yield name, Outcome("missing", {}, reason), {}
            continue
        with context.progress.step(f"{side}: {name}"):
            more = {"asker": asker, "repetitions": repetitions}
            outcome, results = _run(context, kind, load, side, more)
        if outcome.status == "missing":
            context.missing[name] = outcome.reason
        yield name, outcome, results


def _run(
    context: Context, kind: type[Backend], load: Load, side: str, more: Mapping[str, object]
) -> tuple[Outcome, dict[str, Any]]:
    warm_cache(load.payloads)
    with run_directory(context.work) as directory:
        data = directory / "data"
        data.mkdir()
        given = {
            "load": str(load.payloads.parent.resolve()),
            "backend": spelled(kind),
            "directory": str(data),
            **more,
        }
        try:
            values = run_side(f"benchmarks.questions.sides:{side}", given, directory, _TIMEOUT_S)
        except SideError as error:
            values = {"status": "failed", "reason": str(error), "results": {}}
    status, reason, results = (values.pop(name) for name in ("status", "reason", "results"))
    return Outcome(status, values, reason), results


def judged(
    wanted: Sample, outcome: Outcome, result: Mapping[str, Any] | None, truth: object
) -> Sample:
    """A sample of an answer: failed when it is wrong or there is none.

    Args:
        wanted: Study, case, backend and repetition.
        outcome: Of the backend's turn.
        result: What was measured, with the `answer`; or the `error`.
        truth: The right answer.
    """
    if result is None:
        status = "failed" if outcome.status == "ok" else outcome.status
        reason = outcome.reason or "it gave no answer"
        return replace(wanted, status=status, values=outcome.values, reason=reason)
    reason = result.get("error", "")
    if not reason and result["answer"] != truth:
        reason = f"it answered {result['answer']}, and {truth} is right"
    values = {**outcome.values, **result}
    return replace(wanted, status="failed" if reason else "ok", values=values, reason=reason)
