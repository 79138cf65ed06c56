"""`hybridlog stats`: statistics of fields, and rates of topics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from hybridlog.cli.answers import Listing, answering
from hybridlog.cli.binder import command, option
from hybridlog.cli.completion import complete_path
from hybridlog.cli.options import Asking, parse_fields
from hybridlog.cli.render import Column, times

_NAMES = ("count", "nan", "infinite", "min", "max", "mean", "std")


@dataclass(frozen=True, kw_only=True)
class _Given(Asking, Listing):
    fields: str | None = option(
        "Only these fields, also summaries and arrays; without, all that are numbers.",
        "A,B.C",
        shell_complete=complete_path,
    )
    rate: bool = option("Instead: how many messages came in a second.", excludes=("fields",))
    window: str | None = option(
        "With --rate: a row for each so long, such as 1s.", "DURATION", needs=("rate",)
    )

    @property
    def needs_topic(self) -> bool:  # type: ignore[override]
        """True if a topic has to be named."""
        return not self.rate


@command(_Given)
def stats_command(given: _Given) -> None:
    """Show count, extremes, mean of numeric fields; rates of topics.

    Also their standard deviation, and how many values are NaN.
    """
    with answering(given) as asked:
        if given.rate:
            asked.is_empty = False
            rates = asked.query.rate(given.window)
            spans = [rates[name].cast("int64").to_pylist() for name in ("begin", "end")]
            rows = rates.drop_columns(["begin", "end"]).to_pylist()
            found: list[dict[str, Any]] = [
                {"begin_ns": begin, "end_ns": end, **row}
                for begin, end, row in zip(*spans, rows, strict=True)
            ]
            columns = _of_rates(has_windows=given.window is not None)
        else:
            stats = asked.query.stats(*([] if given.fields is None else parse_fields(given.fields)))
            found = [asdict(row) for row in stats]
            columns = _of_fields(found)
        if given.strict:
            asked.query.completeness().check()
        without = "No message." if given.rate else "No field is a number."
        given.show(found, columns, without)


def _of_rates(*, has_windows: bool) -> list[Column]:
    begin, end = times()
    return [
        Column("topic"),
        replace(begin, order=0 if has_windows else 3),
        replace(end, order=2),
        Column("recording", varies=True),
        Column("messages", side="right"),
        Column("Hz", lambda row: row["rate"] and f"{row['rate']:.2f}", "right"),
    ]


def _of_fields(rows: Sequence[Mapping[str, Any]]) -> list[Column]:
    # How many are no numbers is left out only where there are none.
    order = {name: 1 for name in ("nan", "infinite") if not any(row[name] for row in rows)}
    order["std"] = 2
    shown = [Column(name, side="right", order=order.get(name, 0)) for name in _NAMES]
    return [Column("topic", varies=True), Column("field"), *shown]
