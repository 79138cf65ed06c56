"""`hybridlog stats`: statistics of fields, and rates of topics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from hybridlog.cli import output
from hybridlog.cli.answers import Listing, answering
from hybridlog.cli.binder import command, option
from hybridlog.cli.completion import complete_path
from hybridlog.cli.options import Asking, parse_fields
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Mapping

_NAMES = ("count", "nan", "infinite", "min", "max", "mean", "std")
_RATE_COLUMNS: Sequence[output.Column] = [
    ("topic", "left"),
    ("begin", "whole"),
    ("end", "whole"),
    ("recording", "left"),
    ("messages", "right"),
    ("Hz", "right"),
]


@dataclass(frozen=True, kw_only=True)
class _Given(Asking, Listing):
    fields: str | None = option(
        "Only these fields, also summaries and arrays; without, all that are numbers.",
        "A,B.C",
        shell_complete=complete_path,
    )
    rate: bool = option("Instead: how many messages came in a second.")
    window: str | None = option("With --rate: a row for each so long, such as 1s.", "DURATION")

    @property
    def needs_topic(self) -> bool:  # type: ignore[override]
        """True if a topic has to be named."""
        return not self.rate


@command(_Given)
def stats_command(given: _Given) -> None:
    """Show count, extremes, mean of numeric fields; rates of topics.

    Also their standard deviation, and how many values are NaN.
    """
    if given.rate and given.fields is not None:
        raise UsageError("--rate counts messages, which have no --fields: leave one out.")
    if given.window is not None and not given.rate:
        raise UsageError("--window is for --rate.")
    with answering(given) as asked:
        if given.rate:
            asked.is_empty = False
            rates = asked.query.rate(given.window)
            if given.strict:
                asked.query.completeness().check()
            times = [rates[name].cast("int64").to_pylist() for name in ("begin", "end")]
            rows = rates.drop_columns(["begin", "end"]).to_pylist()
            given.answer(
                (
                    {"begin_ns": begin, "end_ns": end, **row}
                    for begin, end, row in zip(*times, rows, strict=True)
                ),
                _RATE_COLUMNS,
                _cells_of_rate,
                spare=[
                    *(["recording"] if len({row["recording"] for row in rows}) == 1 else []),
                    *(["end"] if given.window is not None else ["end", "begin"]),
                ],
                titles=2,
            )
            return
        found = asked.query.stats(*([] if given.fields is None else parse_fields(given.fields)))
        if given.strict:
            asked.query.completeness().check()
        if not found and not given.as_json:
            output.note("No field is a number.")
        several = len({row.topic for row in found}) > 1
        columns: list[output.Column] = [("field", "left"), *((name, "right") for name in _NAMES)]
        if several:
            columns.insert(0, ("topic", "left"))

        def cells(row: Mapping[str, Any]) -> list[str]:
            own = [row["topic"]] if several else []
            return [*own, row["field"], *(_number(row[name]) for name in _NAMES)]

        # How many are no numbers is left out only where there are none.
        spare = [n for n in ("nan", "infinite") if not any(getattr(row, n) for row in found)]
        titles = len(columns) - len(_NAMES)
        given.answer(map(asdict, found), columns, cells, [*spare, "std"], titles)


def _cells_of_rate(row: Mapping[str, Any]) -> list[str]:
    rate = "" if row["rate"] is None else f"{row['rate']:.2f}"
    times = output.begin_and_end(row["begin_ns"], row["end_ns"])
    return [row["topic"], *times, row["recording"], str(row["messages"]), rate]


def _number(value: float | None) -> str:
    if value is None:
        return ""
    return str(value) if isinstance(value, int) else f"{value:.6g}"
