"""Study 2 in a report: what is kept of logs, in real time (Figure 5) and faster."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from benchmarks.report.book import (
    Book,
    by_backend,
    by_case,
    grouped,
    is_whole,
    middle,
    offered,
    offered_messages,
    percents,
    persisted,
    repetitions,
    value,
    with_meaning,
)
from benchmarks.report.look import OURS, databases, title
from benchmarks.report.model import Cell, Graph, Line, Panel, Section, Table, Value
from benchmarks.report.numbers import listed, number
from benchmarks.samples import DAMAGE, Sample
from benchmarks.studies.search import Verdict, bracket, is_over, verdict

STUDY = "persistence"
FASTER = "speed-up"
LOG = "log"
SPEED = "speed"

_MADE = frozenset({"mit1", "mit2", "hcr1", "hcr2"})
_LOGS_A_GRAPH = 6

_PAPER_LOW = 80.0
"""Where the vertical axis of the paper's Figure 5 begins."""


def section(book: Book) -> Section | None:
    """Figure 5 with its numbers; None without samples."""
    samples = book.good(STUDY)
    if not samples:
        return None
    text = (
        f"Logs with all their topics{_beginning(samples)}, published at the pace at "
        "which they were recorded, each topic with its own thread and its own queue of ten. "
        "Persisted is what the backend, closed and opened again, counts, over what was published.",
        "`mit1`, `mit2`, `hcr1`, `hcr2` are made after what is published about the robots of the "
        "paper, whose recordings cannot be had here; the second of each pair is busier. All others "
        "are real logs.",
    )
    tables = (_persisted(samples), _loads(samples))
    return Section(
        "persistence",
        "Study 2: what is kept of logs",
        text,
        tuple(_figure_5(samples)),
        tables,
    )


def speed_up(book: Book) -> Section | None:
    """How fast a log may be played until a backend drops; None without samples."""
    samples = _trials(book)
    if not samples:
        return None
    text = (
        "The same logs, played faster until a message is dropped: the speed is doubled, then the "
        "gap is halved, not so in a quick run. Each trial is one run; the whole search is made "
        "anew for each repetition.",
    )
    logs = _logs(samples)
    rows: list[tuple[Cell, ...]] = []
    for name, group in by_backend(samples).items():
        of = by_case(group, LOG)
        rows.append((title(name), *(_bound(book, of[key]) if key in of else None for key in logs)))
    table = Table(
        "Greatest speed at which everything was kept, times real time",
        ("backend", *(log for (log,) in logs)),
        tuple(rows),
        "Median (least…greatest) of the searches. “or more”: no higher speed was planned, "
        "(harness) it could not be published faster, or (stopped) the search had not come to its "
        "end.",
        title(OURS),
    )
    return Section("speed-up", "Faster than real time", text, (), (table,))


def _trials(book: Book) -> list[Sample]:
    """Trials of the search; one that failed has not kept everything either."""
    return [one for one in book.all if one.study == FASTER and one.status != "missing"]


def _bound(book: Book, samples: Sequence[Sample]) -> str:
    """The greatest speed at which one backend kept all of one log: median and spread."""
    searches = [
        _greatest(of, book.settings(of[-1]))
        for of in grouped(samples, lambda one: one.repetition).values()
    ]
    found = Value.of(speed for speed, _ in searches)
    if found is None:
        return "none tried"
    if not found.low:
        below = f"below {number(min(one.case[SPEED] for one in samples))}x"
        return f"{below} to {number(found.high)}x" if found.high else below
    text = f"{number(found.median)}x"
    if found.low != found.high:
        text += f" ({number(found.low)}…{number(found.high)})"
    ends = {end for _, end in searches}
    if "stopped" in ends:
        return f"{text} or more (stopped)"
    if "late" in ends:
        return f"{text} or more (harness)"
    return f"{text} or more" if "kept" in ends else text


def _greatest(
    trials: Sequence[Sample], settings: Mapping[str, Any]
) -> tuple[float, Verdict | Literal["stopped"]]:
    """The greatest speed below all that were not kept, 0 for none, and what ended the search."""
    verdicts = {float(trial.case[SPEED]): verdict(trial) for trial in trials}
    kept = {speed: found == "kept" for speed, found in verdicts.items()}
    greatest, lost = bracket(kept)
    if not is_over(kept, settings):
        return greatest or 0.0, "stopped"
    return greatest or 0.0, "kept" if lost is None else verdicts[lost]


def _beginning(samples: Sequence[Sample]) -> str:
    """How much of each log was published, if its samples say so."""
    seconds = {str(one.case["seconds"]) for one in samples if "seconds" in one.case}
    if not seconds:
        return ""
    most = listed(sorted(seconds))
    return f", the first {most} s of each if it is longer"


def findings(book: Book) -> list[str]:
    """What Figure 5 shows, in sentences."""
    found = []
    kept_by_all = []
    logs = _logs(book.good(STUDY))
    for (log,), group in logs.items():
        by_name = by_backend(group)
        whole = [name for name, of in by_name.items() if is_whole(of)]
        rest = [name for name in by_name if name not in whole]
        if not rest:
            kept_by_all.append(log)
            continue
        shares = listed([f"{title(n)} {percents(by_name[n])} %" for n in rest])
        names = listed([title(n) for n in whole])
        found.append(
            f"Of {log}, {names} kept everything; not so {shares}."
            if whole
            else f"Of {log} were kept: {shares}."
        )
    if kept_by_all:
        found.append(f"Of {listed(kept_by_all)}, every backend that took part kept everything.")
    for (log,), group in logs.items():
        damage = next((str(one.values[DAMAGE]) for one in group if DAMAGE in one.values), "")
        if damage:
            found.append(f"Of {log} only what can be read was published: {damage}.")
    for (log,), group in _logs(_trials(book)).items():
        bounds = [f"{title(name)} {_bound(book, of)}" for name, of in by_backend(group).items()]
        if bounds:
            found.append(f"Played faster, {log} was kept whole at: {listed(bounds)}.")
    return found


def paper_says(book: Book) -> list[tuple[str, str]]:
    """The paper's sentences on study 2 beside what was found here."""
    said = []
    samples = book.good(STUDY)
    kinds = (("mit", "MIT"), ("hcr", "HCR"))
    for prefix, name in kinds:
        of = [one for one in samples if one.case.get(LOG) in {f"{prefix}1", f"{prefix}2"}]
        groups = by_backend(of)
        shares = {
            one: middle(groups[one], persisted) or 0.0 for one in databases(groups) if groups[one]
        }
        if not shares:
            continue
        shown = listed([f"{title(one)} {percents(groups[one])} %" for one in shares])
        if prefix == "hcr":
            paper = "All three databases persisted 100 % of HCR"
            holds = all(is_whole(groups[one]) for one in shares)
            said_here = "It holds" if holds else "It does not hold"
        else:
            paper = f"None persisted all of {name}, SQLite least"
            dropped = all(not is_whole(groups[one]) for one in shares)
            worst = min(shares, key=lambda one: shares[one])
            last = worst.startswith("sqlite") and shares[worst] < 100
            said_here = (
                f"That none keeps all {'holds' if dropped else 'does not hold'}, that SQLite "
                f"keeps least {'does' if last else 'does not'}"
            )
        said.append((f"{paper}.", f"{said_here}: {shown}."))
    return said


def _figure_5(samples: Sequence[Sample]) -> list[Graph]:
    logs = [log for (log,) in _logs(samples)]
    made = [log for log in logs if log in _MADE]
    real = [log for log in logs if log not in _MADE]
    graphs = []
    if made:
        heading = "Figure 5: persisted messages, logs made after those of the paper"
        graphs.append(_bars(samples, "figure-5", heading, made))
    for first in range(0, len(real), _LOGS_A_GRAPH):
        key = f"figure-5-real-{first // _LOGS_A_GRAPH + 1}"
        heading = "Figure 5 with real logs: persisted messages"
        graphs.append(_bars(samples, key, heading, real[first : first + _LOGS_A_GRAPH]))
    return graphs


def _bars(samples: Sequence[Sample], key: str, heading: str, logs: Sequence[str]) -> Graph:
    shown = [one for one in samples if one.case.get(LOG) in logs]
    lines = tuple(
        Line(
            name,
            tuple(
                (log, one)
                for (log,), group in _logs(of).items()
                if (one := value(group, persisted)) is not None
            ),
        )
        for name, of in by_backend(shown).items()
    )
    lowest = min((one.low for line in lines for _, one in line.points), default=100.0)
    if lowest >= _PAPER_LOW:
        y_range, axis = (_PAPER_LOW, 100.0), "The axis begins at 80 %, as in the paper."
    else:
        y_range, axis = (0.0, 100.0), "The axis begins at 0: less than 80 % was kept of some."
    return Graph(
        key,
        heading,
        f"Median of {repetitions(shown)}; the bars reach from the least to the greatest. {axis}",
        "bars",
        (Panel("", lines),),
        "",
        "persisted, % of the messages",
        y_range=y_range,
    )


def _logs(samples: Sequence[Sample]) -> dict[tuple[str], list[Sample]]:
    """By log: the two that stand for the paper's first, as in its figure."""
    found = by_case(samples, LOG)
    first = {"mit": 0, "hcr": 1}
    names = sorted(found, key=lambda key: (first.get(str(key[0])[:3], 2), str(key[0])))
    return {(str(key[0]),): found[key] for key in names}


def _persisted(samples: Sequence[Sample]) -> Table:
    logs = _logs(samples)
    rows = tuple(
        (
            title(name),
            *(percents([one for one in group if one.backend == name]) for group in logs.values()),
        )
        for name in by_backend(samples)
    )
    return Table(
        "Persisted, % of the messages",
        ("backend", *(log for (log,) in logs)),
        rows,
        with_meaning(f"Median (least…greatest) of {repetitions(samples)}.", samples),
        title(OURS),
    )


def _loads(samples: Sequence[Sample]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for (log,), group in _logs(samples).items():
        rows.append(
            (
                log,
                _plain(value(group, lambda one: float(one.values.get("published", 0)))),
                _plain(value(group, lambda one: float(one.values.get("publish_s", 0)))),
                _plain(value(group, offered_messages)),
                _plain(value(group, offered)),
            )
        )
    return Table(
        "The logs",
        ("log", "messages", "seconds", "messages/s", "MB/s"),
        tuple(rows),
        "As they were published.",
    )


def _plain(found: Value | None) -> str | None:
    return None if found is None else number(found.median)
