"""Plots as a page that needs nothing else: charts to zoom in, drawn by uPlot in the browser."""

from __future__ import annotations

import hashlib
import json
from base64 import b64encode
from collections.abc import Sequence
from html import escape
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hybridlog import __version__
from hybridlog.drawing.lines import Line, drawable, printable
from hybridlog.query.times import format_time

if TYPE_CHECKING:
    from numpy.typing import NDArray

_OWN: Final = Path(__file__).with_name("static")
_VENDOR: Final = Path(__file__).parents[1] / "view" / "static" / "vendor"


def page(found: Sequence[Line], title: str) -> bytes:
    """An HTML page with a chart for each topic."""
    own = (_OWN / "page.js").read_text("utf-8")
    # A block has names of its own.
    script = (_VENDOR / "uPlot.esm.js").read_text("utf-8") + f"{{\n{own}}}\n"
    style = (_VENDOR / "uPlot.min.css").read_text("utf-8") + (_OWN / "page.css").read_text("utf-8")
    charts = [_chart(topic, [*group]) for topic, group in groupby(found, key=lambda x: x.topic)]
    # Nothing in the text of a script may end it.
    data = json.dumps(charts).replace("<", "\\u003c")
    digest = b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = f"default-src 'none'; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"
    recordings = dict.fromkeys((line.recording, line.start) for line in found)
    rows = "".join(
        f"<tr><th>{_text(label)}</th><td>{format_time(start)}</td></tr>"
        for label, start in recordings
    )
    return f"""<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width">
<meta name="generator" content="hybridlog {__version__}">
<title>{_text(title)}</title>
<style>{style}</style>
<h1>{_text(title)}</h1>
<table class="recordings">{rows}</table>
<p>Seconds since the beginning of each recording. Drag to zoom in, double-click for all.</p>
<script id="data" type="application/json">{data}</script>
<script type="module">{script}</script>
</html>
""".encode()


def _chart(topic: str, group: Sequence[Line]) -> dict[str, Any]:
    """The lines of a topic; those of a recording have the same times."""
    tables = []
    several = len({line.recording for line in group}) > 1
    for (recording, start), part in groupby(group, key=lambda line: (line.recording, line.start)):
        lines = [*part]
        which = [recording] if several else []
        corners = [line.series.polyline() for line in lines]
        times = increasing(corners[0][0]) - start
        tables.append(
            {
                "times": _packed(times / 1e9),
                "lines": [
                    {
                        "name": printable(" ".join([line.series.field, *which])),
                        "values": _packed(drawable(values)),
                    }
                    for line, (_, values) in zip(lines, corners, strict=True)
                ],
            }
        )
    return {"title": printable(topic), "tables": tables}


def increasing(times: NDArray[np.int64]) -> NDArray[np.int64]:
    """The times, those that are the same 1 ns apart: charts join lines by their times."""
    steps = np.arange(len(times))
    found: NDArray[np.int64] = np.maximum.accumulate(times - steps) + steps
    return found


def _packed(values: NDArray[np.float64]) -> str:
    return b64encode(values.astype("<f8").tobytes()).decode()


def _text(text: str) -> str:
    return escape(printable(text))
