"""One backend filled and asked in a process of its own, and samples made of what it said."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from benchmarks.harness.run import Outcome
from benchmarks.questions.base import SLOW_TIMES
from benchmarks.samples import Sample
from benchmarks.side import SideError, run_side, warm_cache
from benchmarks.studies.runs import Context, run_directory

if TYPE_CHECKING:
    from benchmarks.backends.base import Backend
    from benchmarks.loads.base import Load

TIMEOUT_S = 900.0
"""A side is ended after it."""
SLOW = "slow"
"""Value of the samples of a question that was slow, and has `SLOW_TIMES` of them at most."""

Result = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Turn:
    """One backend's turn.

    Attributes:
        backend: Its name.
        asker: Who asks it, `module:class`.
        samples: What is wanted of it.
    """

    backend: str
    asker: str
    samples: Sequence[Sample]


def to_do(context: Context, turn: Turn) -> bool:
    """Whether any sample of a turn is not in the journal, nor one that stands for it."""
    return any(
        context.to_do(wanted) and not _stands_for(context, wanted) for wanted in turn.samples
    )


def _stands_for(context: Context, wanted: Sample) -> bool:
    first = replace(wanted, repetition=0)
    return not context.to_do(first) and _is_spared(wanted, context.journal.samples[first.key])


def _is_spared(wanted: Sample, first: Sample | None) -> bool:
    """Whether a repetition is not asked for, since the first one was slow."""
    return wanted.repetition >= SLOW_TIMES and first is not None and bool(first.values.get(SLOW))


def do(
    context: Context,
    turn: Turn,
    *,
    side: str,
    load: Callable[[], Load],
    arguments: Mapping[str, object],
    samples_of: Callable[[Outcome, Sequence[Result]], Iterable[Sample]],
) -> None:
    """Do a turn that has something to do, and note its samples.

    Args:
        context: Where and how.
        turn: Which.
        side: `module:function`; takes the arguments of `benchmarks.questions.sides.ask`.
        load: Gives the load; called only when it is needed.
        arguments: More for the side.
        samples_of: Makes samples out of how the side ended and what it has told.
    """
    if not to_do(context, turn):
        return
    reason = context.missing.get(turn.backend)
    if reason is not None:
        outcome = Outcome("missing", {}, reason)
        _note(context, turn, outcome, [])
        return
    with context.progress.step(f"{turn.samples[0].study}: {turn.backend}"):
        outcome, results = _run(context, turn, side, load(), arguments)
    if outcome.status == "missing":
        context.missing[turn.backend] = outcome.reason
    _note(context, turn, outcome, samples_of(outcome, results))


def _run(
    context: Context, turn: Turn, side: str, load: Load, arguments: Mapping[str, object]
) -> tuple[Outcome, list[Result]]:
    kind: type[Backend] = context.backends[turn.backend]
    warm_cache([load.payloads])
    with run_directory(context.work) as directory:
        data, results = directory / "data", directory / "results.jsonl"
        data.mkdir()
        given = {
            "load": str(load.payloads.parent.resolve()),
            "backend": f"{kind.__module__}:{kind.__qualname__}",
            "directory": str(data),
            "row": turn.backend,
            "asker": turn.asker,
            "results": str(results),
            **arguments,
        }
        try:
            values = run_side(side, given, directory, TIMEOUT_S)
        except SideError as error:
            values = {"status": "failed", "reason": str(error)}
        told = results.read_bytes() if results.is_file() else b""
    # The last line of a side that was ended may be cut off.
    lines = told[: told.rfind(b"\n") + 1].splitlines()
    status, reason = values.pop("status"), values.pop("reason")
    return Outcome(status, values, reason), [json.loads(line) for line in lines]


def _note(context: Context, turn: Turn, outcome: Outcome, found: Iterable[Sample]) -> None:
    """Note what was found, and of what was not, why."""
    known = {sample.key: sample for sample in found}
    for wanted in turn.samples:
        sample = known.get(wanted.key)
        if sample is None and _is_spared(wanted, known.get(replace(wanted, repetition=0).key)):
            continue
        if sample is None:
            status = "failed" if outcome.status == "ok" else outcome.status
            reason = outcome.reason or "it gave no answer"
            sample = replace(wanted, status=status, values=outcome.values, reason=reason)
        context.journal.add(sample)


def judged(wanted: Sample, values: Mapping[str, Any], truth: object, error: str = "") -> Sample:
    """A sample of an answer: failed when it is wrong or there is none.

    Args:
        wanted: Study, case, backend and repetition.
        values: What was measured, with the `answer`.
        truth: The right answer.
        error: Why there is none.
    """
    if error:
        return replace(wanted, status="failed", values=dict(values), reason=error)
    if values["answer"] != truth:
        reason = f"it answered {values['answer']}, and {truth} is right"
        return replace(wanted, status="failed", values=dict(values), reason=reason)
    return replace(wanted, values=dict(values))
