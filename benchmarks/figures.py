"""The figures of the report: lines over message size, and bars, as SVG."""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.numbers import OURS, Spread, ordered, size, title

# They tell apart for people who see fewer colours; a marker says the same once more.
_LOOKS = {
    OURS: ("#d55e00", "o", "-"),
    "hybridlog_recorder": ("#b34700", "d", "--"),
    "hybridlog_api": ("#d55e00", "H", "--"),
    "hybridlog_indexed": ("#b34700", "8", "-."),
    "hybridlog_api_indexed": ("#7a3300", "p", ":"),
    "mongo_json": ("#009e73", "s", "-"),
    "mongo_json_indexed": ("#009e73", "D", "--"),
    "mongo_json_batched": ("#00664b", "<", "-."),
    "postgres_autocommit": ("#56b4e9", "v", "-"),
    "postgres_tuned": ("#2f7ed8", "^", "-"),
    "postgres_tuned_indexed": ("#2f7ed8", ">", "--"),
    "sqlite_udf": ("#cc79a7", "P", "-"),
    "sqlite_json1": ("#aa4499", "X", "-"),
    "bagfile": ("#c79a00", "*", "-"),
    "mcap": ("#7f7f7f", "h", "-."),
    "nothing": ("#9a9a9a", ".", ":"),
}
_STRANGER = ("#882255", "1", "-")
_STYLE = {"svg.fonttype": "none", "font.size": 9, "axes.spines.top": False}

Series = Mapping[Any, Spread]
"""Values by place: message size, or name of a group of bars."""


class Figure(NamedTuple):
    """A figure: for each panel its title, and a series for each backend.

    Attributes:
        key: Of its file.
        title: Also its alternative text.
        label: Of the vertical axis.
        panels: From left to right.
        log_y: Whether the vertical axis is logarithmic.
    """

    key: str
    title: str
    label: str
    panels: Sequence[tuple[str, Mapping[str, Series]]]
    log_y: bool = False


def lines(figure: Figure, directory: Path) -> str:
    """Draw values over message size; returns the file's name."""
    return _draw(figure, directory, _lines)


def bars(figure: Figure, directory: Path) -> str:
    """Draw groups of bars; returns the file's name."""
    return _draw(figure, directory, _bars)


def _draw(figure: Figure, directory: Path, kind: Any) -> str:
    import matplotlib as mpl
    from matplotlib.figure import Figure as Canvas

    with mpl.rc_context({**_STYLE, "svg.hashsalt": figure.key}), warnings.catch_warnings():
        # The viewer's fonts, not ours, draw the names of logs.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        canvas = Canvas(figsize=(10.0, 4.4), layout="constrained")
        axes = canvas.subplots(1, len(figure.panels), squeeze=False, sharey=figure.log_y)[0]
        for one, (heading, series) in zip(axes, figure.panels, strict=True):
            one.set_title(heading)
            one.grid(visible=True, axis="y", alpha=0.4)
            if figure.log_y:
                one.set_yscale("log")
            kind(one, series)
        axes[0].set_ylabel(figure.label)
        handles = {}
        for one in axes:
            for handle, label in zip(*one.get_legend_handles_labels(), strict=True):
                handles.setdefault(label, handle)
        canvas.legend(handles.values(), handles, loc="outside lower center", ncols=4)
        text = io.StringIO()
        canvas.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    path = directory / "figures" / f"{figure.key}.svg"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text.getvalue(), encoding="utf-8")
    return f"figures/{path.name}"


def _style(backend: str) -> dict[str, Any]:
    colour = _LOOKS.get(backend, _STRANGER)[0]
    return {"color": colour, "label": title(backend), "zorder": 4 if backend == OURS else 3}


def _errors(series: Series) -> list[list[float]]:
    return [
        [value.median - value.low for value in series.values()],
        [value.high - value.median for value in series.values()],
    ]


def _lines(axes: Any, panel: Mapping[str, Series]) -> None:
    sizes = sorted({place for series in panel.values() for place in series})
    for name in ordered(panel):
        series = dict(sorted(panel[name].items()))
        _, marker, dash = _LOOKS.get(name, _STRANGER)
        medians = [value.median for value in series.values()]
        places = list(series)
        axes.errorbar(
            places, medians, _errors(series), marker=marker, linestyle=dash, **_style(name)
        )
    axes.set_xscale("log")
    axes.set_xticks(sizes, [size(place) for place in sizes], rotation=45)
    axes.set_xticks([], minor=True)
    axes.set_xlabel("message size")


def _bars(axes: Any, panel: Mapping[str, Series]) -> None:
    groups = list(dict.fromkeys(place for series in panel.values() for place in series))
    width = 0.84 / max(len(panel), 1)
    for row, name in enumerate(ordered(panel)):
        series = panel[name]
        shift = (row - (len(panel) - 1) / 2) * width
        places = [groups.index(place) + shift for place in series]
        medians = [value.median for value in series.values()]
        axes.bar(places, medians, width * 0.9, yerr=_errors(series), **_style(name))
    axes.set_xticks(range(len(groups)), [str(group).replace("_", "\n") for group in groups])
