"""What the paper stops short of: the largest load of which a backend keeps everything."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from benchmarks.report.book import MB, Book, ends
from benchmarks.report.look import OURS, databases, ordered, title
from benchmarks.report.model import Cell, Graph, Line, Panel, Section, Table, Value
from benchmarks.report.numbers import listed, number, size, times
from benchmarks.studies.ceiling import STUDY, Ceiling
from benchmarks.studies.ceiling import ceilings as found_in

_Text = Callable[[Ceiling], str | None]

_NOTE = (
    "≥: the ceiling is above; the harness could offer no more (harness), or no higher rate was "
    "planned (plan). none: something was dropped at every rate that was tried."
)


def section(book: Book) -> Section | None:
    """Ceilings in MB/s and messages/s, and ours over the best database's."""
    ceilings = _ceilings(book)
    if not ceilings:
        return None
    text = (
        "The rate is doubled until a message is dropped, then the gap is halved a few times. The "
        "ceiling is the largest offered load of which everything was found in the backend "
        "afterwards. Each trial is one run, so a ceiling has no spread; it is known to about the "
        "last halving.",
        "A trial is short: what a backend can put off (dirty pages, a journal, work after the last "
        "message) helps it. “Stored” divides by the time until everything was on the disk.",
    )
    return Section(
        "ceilings",
        "How much each can take",
        text,
        (_graph(ceilings),),
        (
            _table(ceilings, "Ceiling: offered load of which all was kept, MB/s", _megabytes),
            _table(ceilings, "The same in messages/s, all topics together", _messages(book)),
            _table(ceilings, "Stored at that load, MB/s, all work included", _kept, ""),
            *_ratios(ceilings),
        ),
    )


def findings(book: Book) -> list[str]:
    """Our ceiling against the best database's, at the least and the greatest size."""
    ceilings = _ceilings(book)
    found = []
    for bytes_ in ends(sorted({one.size for one in ceilings})):
        of_size = [one for one in ceilings if one.size == bytes_]
        pair = _pair(of_size)
        if pair is None:
            continue
        ours, best = pair
        marked = " or more" if ours.limit != "backend" else ""
        found.append(
            f"With {size(bytes_)} messages, hybridlog keeps everything up to "
            f"{number(ours.offered_bytes_s / MB)} MB/s{marked}, "
            f"{times(ours.offered_bytes_s / best.offered_bytes_s)} what the best database does "
            f"({title(best.backend)}, {number(best.offered_bytes_s / MB)} MB/s)."
        )
    short = [one for one in ceilings if one.backend == OURS and one.limit == "harness"]
    if short:
        places = listed([size(one.size) for one in short])
        found.append(
            f"At {places} the harness, not hybridlog, was at its limit: publisher and logger "
            "share the machine."
        )
    return found


def _ceilings(book: Book) -> list[Ceiling]:
    return found_in(one for one in book.all if one.status != "missing")


def _pair(of_size: Sequence[Ceiling]) -> tuple[Ceiling, Ceiling] | None:
    """Ours, and the best of the databases; None when either has no ceiling."""
    known = {one.backend: one for one in of_size if one.rate is not None}
    others = databases(known)
    if OURS not in known or not others:
        return None
    best = max(others, key=lambda name: known[name].offered_bytes_s)
    return known[OURS], known[best]


def _graph(ceilings: Sequence[Ceiling]) -> Graph:
    lines = []
    for name in ordered(one.backend for one in ceilings):
        points = sorted(
            (float(one.size), one.offered_bytes_s / MB)
            for one in ceilings
            if one.backend == name and one.rate is not None
        )
        lines.append(Line(name, tuple((x, Value(y, y, y, 1)) for x, y in points)))
    sizes = sorted({one.size for one in ceilings})
    return Graph(
        "ceilings",
        "Largest load of which everything is kept",
        "Offered load over message size, both axes logarithmic. One search a point. Where the "
        "line of “harness alone” is reached, the harness can offer no more.",
        "lines",
        (Panel("", tuple(lines)),),
        "message size",
        "MB/s",
        log_x=True,
        log_y=True,
        ticks=tuple((float(one), size(one)) for one in sizes),
    )


def _table(ceilings: Sequence[Ceiling], heading: str, text: _Text, note: str = _NOTE) -> Table:
    sizes = sorted({one.size for one in ceilings})
    by_place = {(one.backend, one.size): one for one in ceilings}
    rows = tuple(
        (
            title(name),
            *(
                None if (one := by_place.get((name, bytes_))) is None else text(one)
                for bytes_ in sizes
            ),
        )
        for name in ordered(one.backend for one in ceilings)
    )
    return Table(heading, ("backend", *map(size, sizes)), rows, note, title(OURS))


def _megabytes(one: Ceiling) -> str:
    return "none" if one.rate is None else _bound(one, one.offered_bytes_s / MB)


def _bound(one: Ceiling, value: float) -> str:
    return number(value) if one.limit == "backend" else f"≥ {number(value)} ({one.limit})"


def _kept(one: Ceiling) -> str | None:
    return None if one.rate is None else number(one.stored_bytes_s / MB)


def _messages(book: Book) -> _Text:
    topics = {
        one.case.get("size"): one.case.get("topics") for one in book.all if one.study == STUDY
    }

    def text(one: Ceiling) -> str | None:
        count = topics.get(one.size)
        if one.rate is None or not isinstance(count, int):
            return None
        return _bound(one, one.rate * count)

    return text


def _ratios(ceilings: Sequence[Ceiling]) -> list[Table]:
    sizes = sorted({one.size for one in ceilings})
    cells: list[Cell] = []
    names: list[Cell] = []
    for bytes_ in sizes:
        pair = _pair([one for one in ceilings if one.size == bytes_])
        cells.append(
            None if pair is None else number(pair[0].offered_bytes_s / pair[1].offered_bytes_s)
        )
        names.append(None if pair is None else title(pair[1].backend))
    if all(cell is None for cell in cells):
        return []
    return [
        Table(
            "hybridlog's ceiling over the best database's",
            ("", *map(size, sizes)),
            (("ratio", *cells), ("best database", *names)),
        )
    ]
