"""Graphs drawn as SVG with matplotlib; the same graph gives the same bytes."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import replace
from textwrap import wrap
from typing import TYPE_CHECKING, Any
from warnings import catch_warnings, filterwarnings

from benchmarks.report.look import OURS, Look, look, ordered
from benchmarks.report.model import Graph, Line, Panel, Value
from hybridlog.cli.output import printable

if TYPE_CHECKING:
    from collections.abc import Iterator

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CURE = "matplotlib is not installed, so there are no figures: pip install -e '.[bench]'"

INK = "#010203"
"""Of text and axes while drawing; the page puts a colour of its theme in its place."""
GRID = "#030201"
"""Of the grid lines, likewise."""

_WIDTH = 9.6
_LEGEND_ROW = 0.22
_APART = 1.015
_MARGIN = 1.3
_NOTHING = Value(math.nan, math.nan, math.nan, 0)
_NAMES = 90
"""Letters that fit side by side below a figure."""
_STYLE: dict[Any, Any] = {
    "font.size": 9.0,
    "font.family": ["DejaVu Sans"],
    "axes.titlesize": 9.5,
    "axes.labelsize": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "legend.frameon": False,
    "svg.fonttype": "none",
    "text.parse_math": False,
    "errorbar.capsize": 2.0,
}


class FiguresMissingError(Exception):
    """matplotlib is not installed; the message says how to get it."""


def svg(graph: Graph, *, ink: str = "#222222", grid: str = "#d8d8d8") -> str:
    """A figure as an SVG element, for a file of its own or inside a page.

    Args:
        graph: What to draw.
        ink: Colour of text and axes, as CSS has it.
        grid: Colour of the grid lines.

    Raises:
        FiguresMissingError: matplotlib is not installed.
    """
    stream = io.StringIO()
    with _drawn(graph) as figure, catch_warnings():
        # The viewer's fonts, not ours, draw the names of logs.
        filterwarnings("ignore", message="Glyph .* missing from font")
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    # Several of them stand in one page, where every id must be the only one.
    text = re.sub(r'\bid="', f'id="{graph.key}-', text)
    text = re.sub(r'href="#', f'href="#{graph.key}-', text)
    text = text.replace("url(#", f"url(#{graph.key}-")
    text = text.replace(INK, ink).replace(GRID, grid)
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text, flags=re.DOTALL)
    named = f'<svg role="img" aria-label="{_attribute(graph.title)}"'
    return text.replace("<svg", named, 1).rstrip() + "\n"


@contextmanager
def _drawn(graph: Graph) -> Iterator[Figure]:
    try:
        import matplotlib as mpl
        from matplotlib.figure import Figure
        from matplotlib.layout_engine import ConstrainedLayoutEngine
    except ImportError as error:
        raise FiguresMissingError(CURE) from error
    with mpl.rc_context({**_STYLE, "svg.hashsalt": graph.key}):
        backends = ordered(line.backend for panel in graph.panels for line in panel.lines)
        offered = any(panel.offered for panel in graph.panels)
        columns = 4
        rows = -(-(len(backends) + offered) // columns)
        below = 0.15 + _LEGEND_ROW * rows
        tall = 3.1 if len(graph.panels) > 1 else 3.4
        figure = Figure(figsize=(_WIDTH, tall + below), layout="constrained")
        high = tall + below
        engine = figure.get_layout_engine()
        assert isinstance(engine, ConstrainedLayoutEngine)
        engine.set(rect=(0, below / high, 1, tall / high))
        all_axes = figure.subplots(1, len(graph.panels), squeeze=False, sharey=_shares(graph))[0]
        for axes, panel in zip(all_axes, graph.panels, strict=True):
            if graph.kind == "bars":
                _bars(axes, panel, backends)
            else:
                _lines(axes, panel)
            _dress(axes, graph, panel, first=axes is all_axes[0])
        _legend(figure, graph, backends, offered=offered, columns=columns)
        yield figure


def _shares(graph: Graph) -> bool:
    return graph.y_range is not None or graph.log_y


def _lines(axes: Axes, panel: Panel) -> None:
    if panel.offered:
        places, loads = zip(*panel.offered, strict=True)
        axes.plot(places, loads, color=INK, linestyle=(0, (4, 3)), linewidth=1.0, zorder=1)
    # Ours last, on top: where all keep up, the lines lie on one another.
    for line in sorted(panel.lines, key=lambda one: one.backend == OURS):
        if line.points:
            place = panel.lines.index(line) - (len(panel.lines) - 1) / 2
            _line(axes, _parted(panel, line), 1.0 if panel.offered else _APART**place)


def _parted(panel: Panel, line: Line) -> Line:
    """A line that ends and begins anew where the panel has places between two of its points.

    Joined, they would say something of what was not measured.
    """
    measured = {_place(x) for one in panel.lines for x, _ in one.points}
    points: list[tuple[float | str, Value]] = []
    for x, value in line.points:
        if points and any(_place(points[-1][0]) < other < _place(x) for other in measured):
            points.append((x, _NOTHING))
        points.append((x, value))
    return replace(line, points=tuple(points))


def _line(axes: Axes, line: Line, shift: float) -> None:
    """One backend's line; `shift` moves it aside, so that bars do not hide each other."""
    style = look(line.backend)
    ours = line.backend == OURS
    axes.errorbar(
        [_place(x) * shift for x, _ in line.points],
        [value.median for _, value in line.points],
        yerr=_errors(line),
        color=style.colour,
        marker=style.marker,
        linestyle=style.dash,
        linewidth=2.4 if ours else 1.3,
        markersize=6 if ours else 4.5,
        elinewidth=1.0,
        zorder=4 if ours else 3,
    )


def _bars(axes: Axes, panel: Panel, backends: Sequence[str]) -> None:
    groups = list(dict.fromkeys(x for line in panel.lines for x, _ in line.points)) or [""]
    width = 0.84 / max(len(backends), 1)
    for line in panel.lines:
        style = look(line.backend)
        shift = (backends.index(line.backend) - (len(backends) - 1) / 2) * width
        axes.bar(
            [groups.index(x) + shift for x, _ in line.points],
            [value.median for _, value in line.points],
            width * 0.9,
            yerr=_errors(line),
            color=style.colour,
            hatch=_hatch(style),
            edgecolor=_edge(line.backend),
            linewidth=1.0 if line.backend == OURS else 0.0,
            error_kw={"ecolor": INK, "elinewidth": 0.8, "capsize": 1.5},
            zorder=3,
        )
    axes.set_xticks(
        range(len(groups)), [_folded(str(group), _NAMES // len(groups)) for group in groups]
    )


def _folded(name: str, width: int) -> str:
    """A name on several lines, broken after its underscores, so that neighbours do not touch."""
    pieces = wrap(printable(name).replace("_", "_ "), max(width, 8), break_on_hyphens=False)
    return "\n".join(piece.replace("_ ", "_") for piece in pieces)


def _hatch(style: Look) -> str:
    """The second way to set up a system has its colour, so its bars are striped."""
    return "////" if style.dash == "--" else ""


def _edge(backend: str) -> str:
    """The stripes have the edge's colour."""
    return INK if backend == OURS else "#ffffff"


def _errors(line: Line) -> list[list[float]]:
    return [
        [value.median - value.low for _, value in line.points],
        [value.high - value.median for _, value in line.points],
    ]


def _dress(axes: Axes, graph: Graph, panel: Panel, *, first: bool) -> None:
    axes.set_title(panel.title)
    if first or not _shares(graph):
        axes.set_ylabel(graph.y_label if first else "")
    axes.set_xlabel(graph.x_label)
    axes.grid(True, axis="y", zorder=0)
    axes.set_axisbelow(True)
    if graph.log_x:
        axes.set_xscale("log")
    if graph.log_y:
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(_plain_number)
        axes.yaxis.set_minor_formatter(_minor_number)
    if graph.ticks:
        _label_ticks(axes, graph.ticks, many=len(graph.panels) > 1)
    if graph.y_range is not None:
        axes.set_ylim(*graph.y_range)
        axes.set_yticks(
            [graph.y_range[0] + n * (graph.y_range[1] - graph.y_range[0]) / 4 for n in range(5)]
        )
    elif not graph.log_y:
        axes.set_ylim(bottom=0)


def _label_ticks(axes: Axes, ticks: Sequence[tuple[float, str]], *, many: bool) -> None:
    places = [place for place, _ in ticks]
    axes.set_xticks(places, [label for _, label in ticks], minor=False)
    axes.set_xticks([], minor=True)
    # Also a single place has room to both sides.
    axes.set_xlim(places[0] / _MARGIN, places[-1] * _MARGIN)
    if len(ticks) > (4 if many else 9):
        for label in axes.get_xticklabels():
            label.set_rotation(50)
            label.set_horizontalalignment("right")
            label.set_rotation_mode("anchor")


def _plain_number(value: float, _position: float | None = None) -> str:
    return f"{value:,.0f}" if value >= 1 else f"{value:g}"


def _minor_number(value: float, _position: float | None = None) -> str:
    """Between the powers of ten only 2 and 5, so that labels do not touch."""
    shown = f"{value:g}"
    return _plain_number(value) if shown.lstrip("0.")[:1] in {"2", "5"} else ""


def _legend(
    figure: Figure, graph: Graph, backends: Sequence[str], *, offered: bool, columns: int
) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = []
    for name in backends:
        style = look(name)
        if graph.kind == "bars":
            handles.append(
                Patch(
                    facecolor=style.colour,
                    edgecolor=_edge(name),
                    hatch=_hatch(style),
                    linewidth=1.0 if name == OURS else 0.0,
                    label=style.title,
                )
            )
        else:
            handles.append(
                Line2D(
                    [],
                    [],
                    color=style.colour,
                    marker=style.marker,
                    linestyle=style.dash,
                    linewidth=2.4 if name == OURS else 1.3,
                    markersize=6 if name == OURS else 4.5,
                    label=style.title,
                )
            )
    if offered:
        dashed = Line2D([], [], color=INK, linestyle=(0, (4, 3)), linewidth=1.0, label="offered")
        handles.append(dashed)
    if handles:
        figure.legend(
            handles=handles, loc="lower center", ncols=min(columns, len(handles)), fontsize=8.5
        )


def _place(x: float | str) -> float:
    assert not isinstance(x, str), "names of groups are for bars"
    return x


def _attribute(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
