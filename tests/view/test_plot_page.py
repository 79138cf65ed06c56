"""The page of `hybridlog plot -o NAME.html`, in a browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from hybridlog.drawing.lines import Line
from hybridlog.drawing.page import page as page_of
from hybridlog.drawing.series import Series

if TYPE_CHECKING:
    from playwright.sync_api import Page

START = 1_748_937_600 * 10**9
HOSTILE = "</script><script>document.title = 'taken'</script>"


def line(topic: str, recording: str, field: str, times: list[float], values: list[float]) -> Line:
    at = np.array([START + round(time * 1e9) for time in times])
    numbers = np.array(values, np.float64)
    return Line(topic, recording, START, Series(field, at, numbers, numbers, True))


@pytest.mark.peer("browser")
def test_a_page_without_a_server(page: Page, tmp_path: Path) -> None:
    nan = float("nan")
    times = [0.0, 1.0, 1.0, 2.0, 3.0, 4.0]
    found = [
        line("/odom", "a", "speed", times, [0.25, 0.5, 0.75, nan, 1.0, nan]),
        line("/odom", "a", HOSTILE, times, [1, 2, 3, 4, float("inf"), 6]),
        line("/odom", "b", "speed", [0.5, 9.5], [3, 4]),
        line(HOSTILE, "a", "y", [1.0, 2.0, 3.0], [1e12, 1.7e308, -1.7e308]),
    ]
    path = tmp_path / "page.html"
    path.write_bytes(page_of(found, HOSTILE))
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto(path.as_uri())
    assert asked == [path.as_uri()]
    assert page.title() == HOSTILE
    assert page.locator("h1").inner_text() == HOSTILE
    assert page.locator("h2").all_inner_texts() == ["/odom", HOSTILE]
    assert page.locator("canvas").count() == 2
    names = page.locator(".uplot").first.locator(".u-legend th").all_inner_texts()
    assert names == ["time", "speed a", f"{HOSTILE} a", "speed b"]
    # The legend has the values at the cursor; of two at the same time, the last one near it.
    over = page.locator(".u-over").first
    box = over.bounding_box()
    assert box is not None

    def shown_at(seconds: float, whole: float) -> list[str]:
        page.mouse.move(box["x"] + box["width"] * seconds / whole, box["y"] + 50)
        return page.locator(".uplot").first.locator(".u-value").all_inner_texts()[:3]

    assert shown_at(0.02, 9.5) == ["+0.000000 s", "0.25", "1"]
    assert shown_at(1.02, 9.5) == ["+1.000000 s", "0.75", "3"]
    assert shown_at(2.0, 9.5) == ["+2.000000 s", "-", "4"]
    assert shown_at(3.0, 9.5) == ["+3.000000 s", "1", "-"]
    # Dragging zooms in, in all charts; a double click shows everything again.
    page.mouse.move(box["x"] + 1, box["y"] + 50)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 50, steps=4)
    page.mouse.up()
    assert shown_at(3.0, 4.75)[0] == "+3.000000 s"
    over.dblclick()
    assert shown_at(3.0, 9.5)[0] == "+3.000000 s"
