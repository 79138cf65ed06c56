"""Plots: the lines of fields of several topics and recordings, and their picture by matplotlib."""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Final

import numpy as np
from msgspec import Struct

from hybridlog.drawing.series import Numbers, Series, known_fields, series
from hybridlog.frames.names import is_summary
from hybridlog.query.query import Query, narrowed, spans_of
from hybridlog.query.times import format_time
from hybridlog_storage.errors import UsageError, extra

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.text import Text
    from numpy.typing import NDArray


DPI: Final = 100
_UNITS = ((300, 1, "seconds"), (3 * 3600, 60, "minutes"), (3 * 86_400, 3600, "hours"))


def figure(found: Sequence[Line], *, size: tuple[int, int], form: str) -> bytes:
    """A picture, `png`, `svg` or `pdf`, with axes for each topic, one below the other.

    The lines are by topic, the size is width and height in pixels.
    """
    with extra("plot", "a plot needs matplotlib"):
        from matplotlib import rc_context
        from matplotlib.figure import Figure

    topics = [list(group) for _, group in groupby(found, key=lambda line: line.topic)]
    file = io.BytesIO()
    # Text stays text, and the same data make the same file.
    plain = rc_context({"svg.fonttype": "none", "svg.hashsalt": "hybridlog"})
    with warnings.catch_warnings(), plain:
        # Letters that the font lacks are boxes; in a picture that is too small, names overlap.
        warnings.filterwarnings("ignore", "Glyph|constrained_layout")
        made = Figure((size[0] / DPI, size[1] / DPI), dpi=DPI, layout="constrained")
        several = made.subplots(max(len(topics), 1), 1, sharex=True, squeeze=False)[:, 0]
        for axes, group in zip(several, topics, strict=False):
            _draw(axes, group)
        for axes in several[:-1]:
            axes.set_xlabel("")
        about = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(form)
        made.savefig(file, format=form, dpi=DPI, metadata=about)
    return file.getvalue()


def _draw(axes: Axes, found: Sequence[Line]) -> None:
    """Draw lines of a topic, with names, units and a legend."""
    ends = [line.series.times[-1] - line.start for line in found if len(line.series.times)]
    length = max(ends, default=0) / 1e9
    step, unit = next(((s, u) for most, s, u in _UNITS if length <= most), (86_400, "days"))
    drawn = []
    for number, line in enumerate(found):
        times, values = line.series.polyline()
        at = (times - line.start) / (1e9 * step)
        (curve,) = axes.plot(at, drawable(values), color=f"C{number}", linewidth=1.2)
        shown, alone = line.series, line.series.alone()
        marks = (shown.times[alone] - line.start) / (1e9 * step)
        axes.plot(marks, drawable(shown.least[alone]), ".", color=f"C{number}", markersize=4)
        drawn.append(curve)
    recordings = {(line.recording, line.start) for line in found}
    since, names = "the beginning of each recording", [line.series.field for line in found]
    if len(recordings) == 1:
        ((name, start),) = recordings
        since = f"{format_time(start)}, {name}"
    else:
        names = [f"{line.series.field} {line.recording}" for line in found]
    _label(axes.set_xlabel(""), f"{unit} since {since}")
    _label(axes.set_title("", loc="left", fontsize="medium"), found[0].topic)
    axes.grid(visible=True, alpha=0.3)
    axes.margins(x=0.01)
    axes.spines[["top", "right"]].set_visible(False)
    if len(found) == 1:
        _label(axes.set_ylabel(""), names[0])
        return
    # Matplotlib hides names that begin with an underscore.
    legend = axes.legend(
        drawn,
        [f" {name}" for name in names],
        loc="upper left",
        bbox_to_anchor=(1, 1),
        fontsize="small",
        frameon=False,
    )
    for text, name in zip(legend.get_texts(), names, strict=True):
        _label(text, name)


def _label(text: Text, words: str) -> None:
    """Set a text that is shown as it is: names in logs are no formulas, and control nothing."""
    text.set_parse_math(False)
    text.set_text("".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in words))


MAX_LINES: Final = 50
"""Lines that can be told apart, with good will."""
_GREATEST: Final = 1e300


class Line(Struct, frozen=True):
    """A field of a topic in a recording, which starts at a time in ns."""

    topic: str
    recording: str
    start: int
    series: Series


def lines(query: Query, fields: Sequence[str], *, pixels: int) -> list[Line]:
    """The fields of a query over time, by topic and recording; the query's counters are set.

    Each of its topics has a line for each of the fields (as for `series`) that it has, `MAX_LINES`
    at most in all.
    """
    summaries = {summary.id: summary for summary in query.source.now().summaries_of(query.question)}
    with query.counters.timed():
        found: list[Line] = []
        had: set[str] = set()
        for one in (narrowed(query, topic) for topic in query.topics):
            for recording in spans_of(one):
                part, about = one.in_recording(recording), summaries[recording]
                known = known_fields(part)
                own = [x for x in fields if _is_among(x.partition("[")[0], known)]
                had.update(own)
                drawn = series(part, own, pixels=pixels) if own or not fields else []
                query.counters.add(part.counters)
                found += [Line(one.topics[0], about.name, about.extent[0], x) for x in drawn]
                if len(found) > MAX_LINES:
                    raise UsageError(
                        f"A plot has at most {MAX_LINES} lines: name fewer fields, or choose "
                        "recordings with -r."
                    )
    for field in fields:
        if field not in had:
            narrowed(query, query.topics[0]).fields(field.partition("[")[0])  # says what is wrong
    return found


def _is_among(path: str, known: Mapping[str, str]) -> bool:
    """True for a field, a message with fields, or a summary of an array."""
    return any(one == path or one.startswith(f"{path}.") for one in known) or is_summary(
        path, known
    )


def drawable(values: Numbers) -> NDArray[np.float64]:
    """Values for an axis: NaN for infinite ones, and none so great that a range overflows."""
    found = np.clip(values.astype(np.float64), -_GREATEST, _GREATEST)
    found[np.isinf(values)] = np.nan
    return found
