"""What was not run and why, on what the rest ran, and how to run it again."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.report import coverage
from benchmarks.report.book import Book, by_backend, grouped, mapping
from benchmarks.report.look import ordered, title
from benchmarks.report.model import Cell, Section, Table
from benchmarks.report.numbers import listed
from benchmarks.report.paper import NOT_RUN
from benchmarks.samples import Journal, Sample

_MACHINE = (
    ("cpu", "processor"),
    ("cores", "processors in use"),
    ("memory_gib", "memory, GiB"),
    ("disk", "disk"),
    ("system", "system"),
    ("python", "Python"),
    ("mongod", "MongoDB"),
    ("postgres", "PostgreSQL"),
    ("sqlite", "SQLite"),
    ("packages", "packages"),
    ("revision", "revision"),
    ("seed", "seed"),
    ("quick", "quick"),
    ("started", "started"),
    ("load_1min", "load at the start"),
)
_DIFFERENT = (
    *("cpu", "cores", "memory_gib", "disk", "system"),
    *("python", "mongod", "postgres", "sqlite", "packages", "revision"),
)
"""What makes figures of two runs no longer one measurement."""


def warnings(headers: Sequence[Mapping[str, Any]]) -> list[str]:
    """Sentences on runs that were put together although they differ."""
    if len(headers) < 2:
        return []
    names = dict(_MACHINE)
    differ = [
        names[key] for key in _DIFFERENT if len({_text(header.get(key)) for header in headers}) > 1
    ]
    if not differ:
        return []
    return [
        "These figures were taken in several runs that were not alike: they differ in "
        f"{', '.join(differ)} (see the end)."
    ]


def not_run(book: Book) -> Section:
    """What this run lacks, and what the benchmark cannot do at all."""
    tables = []
    missing = grouped(book.bad("missing"), lambda one: (one.backend, one.reason))
    if missing:
        tables.append(
            Table(
                "Backends that were missing in this run",
                ("backend", "why, and what would help", "runs left out"),
                tuple(
                    (name, reason, str(len(missing[name, reason])))
                    for name, reason in sorted(missing, key=lambda one: _place(one[0], missing))
                ),
            )
        )
    failed = book.bad("failed")
    if failed:
        tables.append(
            Table(
                "Runs that failed",
                ("run", "backend", "why"),
                tuple((about(one), one.backend, one.reason) for one in failed),
                "Their figures are not in any table above.",
            )
        )
    lacking = coverage.table(book)
    if lacking is not None:
        tables.append(lacking)
    tables.append(Table("What this benchmark leaves out", ("", "why"), NOT_RUN))
    return Section(
        "not-run",
        "What we could not run",
        ("An absent row looks like a result. These are the ones that are absent, and why.",),
        (),
        tuple(tables),
    )


def _place(backend: str, missing: Mapping[tuple[str, str], object]) -> int:
    return ordered(name for name, _ in missing).index(backend)


def about(sample: Sample) -> str:
    """A run in words: `throughput, size 5000, rate 4, repetition 1`."""
    case = [f"{name} {_text(part)}" for name, part in sample.case.items()]
    return ", ".join([sample.study, *case, f"repetition {sample.repetition + 1}"])


def systems(headers: Sequence[Mapping[str, Any]]) -> Section | None:
    """What each backend is and how it is set up, as it said itself when it was run."""
    about_each: dict[str, Mapping[str, Any]] = {}
    for header in headers:
        about_each.update(mapping(header.get("backends")))
    if not about_each:
        return None
    rows = tuple(
        (
            name,
            title(name),
            _text(mapping(about_each[name]).get("kind", "")),
            _text(mapping(about_each[name]).get("about", "")),
        )
        for name in ordered(about_each)
    )
    table = Table(
        "Backends", ("name", "in the figures", "kind", "what it is, and its settings"), rows
    )
    text = (
        "Where they took part, a plain MCAP file, written as the mcap package does it unless told "
        "otherwise, and a backend that keeps nothing (“harness alone”) stand beside the databases: "
        "the first has no index to make, the second is what the harness itself can carry.",
        "In all tables a cell is the median, with the least and the greatest repetition behind it; "
        "a spread of less than 1 % is left out. “—” was not measured.",
    )
    return Section("systems", "The systems", text, (), (table,))


def findings(book: Book) -> list[str]:
    """What went wrong, in sentences."""
    found = []
    lost = {
        name: int(sum(float(one.values.get("lost") or 0) for one in group))
        for name, group in by_backend(one for one in book.all if one.status == "ok").items()
    }
    shown = [f"{title(name)} {count:,}" for name, count in lost.items() if count > 0]
    if shown:
        found.append(
            "Messages that a backend had taken without an error and that were not there when it "
            f"was opened again: {listed(shown)}."
        )
    errors = {
        name: int(sum(float(one.values.get("errors") or 0) for one in group))
        for name, group in by_backend(one for one in book.all if one.status == "ok").items()
    }
    refused = [f"{title(name)} {count:,}" for name, count in errors.items() if count > 0]
    if refused:
        found.append(f"Messages that a backend refused with an error: {listed(refused)}.")
    missing = ordered({one.backend for one in book.bad("missing")})
    if missing:
        found.append(
            f"Not measured, because they cannot run here: {listed([title(n) for n in missing])} "
            "(see “What we could not run”)."
        )
    failed = book.bad("failed")
    if failed:
        names = listed([title(name) for name in ordered({one.backend for one in failed})])
        number = f"{len(failed)} run{'s' if len(failed) != 1 else ''}"
        found.append(f"{number} failed ({names}); the reasons stand below.")
    return found


def machine(journal: Journal) -> Section:
    """Machine, versions, seeds, settings, of each run that the journal has."""
    # A run that was stopped and taken up again is the same one to a reader.
    together = grouped(range(len(journal.headers)), lambda place: _lasting(journal.headers[place]))
    distinct = [journal.headers[places[0]] for places in together.values()]
    shared: dict[str, object] = {}
    different: dict[str, list[object]] = {}
    for key, name in (*_MACHINE, *_settings(distinct)):
        same, others = _apart([_of(header, key) for header in distinct])
        if same is not None:
            shared[name] = same
        if any(one is not None for one in others):
            different[name] = others
    tables = [
        Table(
            "Machine, versions, settings",
            ("", "every run" if len(distinct) > 1 else "the run"),
            tuple((name, _text(one)) for name, one in shared.items()),
        )
    ]
    if len(distinct) > 1:
        numbers = {place: n for n, own in enumerate(together.values(), 1) for place in own}
        tables += [_runs(distinct, different), _taken(journal, numbers)]
        text = ["To run them again: the commands in the last column, in their order."]
    else:
        commands = [command for header in distinct if (command := _command(header))]
        text = [f"To run it again: `{command}`" for command in commands]
    text.append(
        "The same command goes on where it was stopped; `--restart` begins anew. "
        "`python -m benchmarks report` draws this report again from the journal alone. "
        "Loads are made from the seed, so another machine publishes the same bytes."
    )
    return Section(
        "rerun", "Machine, versions, and how to run it again", tuple(text), (), tuple(tables)
    )


def _lasting(header: Mapping[str, Any]) -> str:
    """What a run has in common with itself taken up again."""
    kept = {name: part for name, part in header.items() if name not in _MOMENT}
    return json.dumps(kept, sort_keys=True)


def _taken(journal: Journal, numbers: Mapping[int, int]) -> Table:
    """Which run each figure was taken in: by backend, and what was measured."""
    good = [
        one
        for key, one in journal.samples.items()
        # A journal may come from elsewhere: of a study that is not known, or of no run.
        if one.status == "ok" and one.study in coverage.STUDIES and journal.runs[key] in numbers
    ]
    whats = sorted({coverage.what(one) for one in good})

    def day(place: int) -> str:
        return str(journal.headers[place].get("started", ""))[:10]

    def shown(samples: Sequence[Sample]) -> str | None:
        days = grouped(sorted({journal.runs[one.key] for one in samples}), day)
        runs = {when: dict.fromkeys(str(numbers[p]) for p in of) for when, of in days.items()}
        return "; ".join(f"{when}: {', '.join(of)}" for when, of in runs.items()) or None

    rows = []
    for backend, own in by_backend(good).items():
        by_what = grouped(own, coverage.what)
        rows.append((title(backend), *(shown(by_what.get(what, ())) for what in whats)))
    return Table(
        "What is of which run",
        ("", *(name for _, name in whats)),
        tuple(rows),
        "The day, and the numbers that the runs have in the table above.",
    )


def _apart(cells: list[object]) -> tuple[object, list[object]]:
    """What is the same in all runs, None without any; and of each what is not."""
    if not cells or all(one == cells[0] for one in cells):
        return next(iter(cells), None), []
    maps = [mapping(one) for one in cells]
    same = {k: v for k, v in maps[0].items() if all(k in one and one[k] == v for one in maps)}
    if not same:
        return None, cells
    return same, [{k: v for k, v in one.items() if k not in same} or None for one in maps]


def _runs(headers: Sequence[Mapping[str, Any]], different: Mapping[str, list[object]]) -> Table:
    """A row a run, with what is not the same in all."""
    parts = {name for _, name in _settings(headers)}
    plain = [name for name in different if name not in parts]
    rows: list[tuple[Cell, ...]] = []
    for number, header in enumerate(headers):
        cells = {name: found[number] for name, found in different.items()}
        settings = [
            f"{name}: {_text(one)}"
            for name, one in cells.items()
            if name in parts and one is not None
        ]
        command = _command(header)
        rows.append(
            (
                str(number + 1),
                *(None if cells[name] is None else _text(cells[name]) for name in plain),
                "; ".join(settings) or None,
                f"`{command}`" if command else None,
            )
        )
    return Table("The runs", ("run", *plain, "settings", "command"), tuple(rows))


_MOMENT = frozenset({"started", "load_1min"})


def _settings(headers: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    names = dict.fromkeys(name for header in headers for name in mapping(header.get("settings")))
    return [(f"settings.{name}", name.replace("_", " ")) for name in names]


def _of(header: Mapping[str, Any], key: str) -> object:
    if key.startswith("settings."):
        return mapping(header.get("settings")).get(key.removeprefix("settings."))
    return header.get(key)


def _command(header: Mapping[str, Any]) -> str:
    words = header.get("command")
    return shlex.join(words) if isinstance(words, list) else ""


def _text(part: object) -> str:
    if isinstance(part, Mapping):
        return ", ".join(f"{name} {_text(one)}" for name, one in part.items() if one is not None)
    if isinstance(part, list | tuple):
        return ", ".join(map(_text, part))
    if isinstance(part, bool):
        return "yes" if part else "no"
    return str(part)
