"""`hybridlog plot`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from hybridlog.cli.answers import answering, check_room, form_of, write_bytes
from hybridlog.cli.options import (
    Filtered,
    Forced,
    command,
    option,
    parse_fields,
)

if TYPE_CHECKING:
    pass


_WIDTH, _HEIGHT = 1200, 400


class _Plot(Filtered, Forced):
    needs_topic: ClassVar[bool] = True
    fields: str | None = option(
        "Fields that are numbers (ranges.min, position[2]), or messages with numbers.",
        "A,B.C",
    )
    output: Path = option(
        "Write this picture: .png, .svg, .pdf.", "FILE", short="-o", required=True
    )


@command(_Plot)
def plot_command(given: _Plot) -> None:
    """Draw fields over time."""
    form = form_of(given.output, {f".{name}": name for name in ("png", "svg", "pdf")})
    check_room(given.output, force=given.force)
    with answering(given) as query:
        from hybridlog.drawing.figure import figure, lines

        names = [] if given.fields is None else parse_fields(given.fields)
        found = lines(query, names, pixels=_WIDTH)
        size = _WIDTH, _HEIGHT * max(1, len({line.topic for line in found}))
        write_bytes(given.output, figure(found, size=size, form=form))
