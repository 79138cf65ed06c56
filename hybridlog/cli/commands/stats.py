"""`hybridlog stats`: statistics of fields."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from msgspec.structs import asdict

from hybridlog.cli.answers import Listing, answering
from hybridlog.cli.options import (
    Filtered,
    command,
    option,
    parse_fields,
)
from hybridlog.cli.output import Column

if TYPE_CHECKING:
    pass


_MEASURES = ("count", "nan", "infinite", "min", "max", "mean", "std")


class _Stats(Filtered, Listing):
    needs_topic: ClassVar[bool] = True
    fields: str | None = option(
        "Only these fields, also summaries and arrays; without, all that are numbers.",
        "A,B.C",
    )


@command(_Stats)
def stats_command(given: _Stats) -> None:
    """Show count, extremes, mean of numeric fields.

    Also their standard deviation, and how many values are NaN.
    """
    with answering(given) as query:
        stats = query.stats(*([] if given.fields is None else parse_fields(given.fields)))
        found = [asdict(row) for row in stats]
        if given.strict:
            query.completeness().check()
        shown = [Column(name, kind="number", order=name == "std") for name in _MEASURES]
        columns = [Column("topic", varies=True), Column("field"), *shown]
        given.show(found, columns, "No field is a number.")
