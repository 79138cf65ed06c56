"""The timeline against what queries answer, by itself and seen in a browser."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest

import hybridlog as hl
from tests import places
from tests.damage import flip
from tests.view.conftest import lane_of, served, unpacked, until

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from playwright.sync_api import Page
    from starlette.testclient import TestClient

SECOND = 10**9


class Lane(NamedTuple):
    counts: NDArray[Any]
    gaps: NDArray[Any]
    exact: bool
    period: float


class Picture(NamedTuple):
    head: dict[str, Any]
    lanes: list[Lane]
    size: int


def picture(client: TestClient, topics: list[str], begin: int, end: int, pixels: int) -> Picture:
    asked = {"recording": "robot", "begin": begin, "end": end, "pixels": pixels, "topic": topics}
    return picture_of(client, asked)


def picture_of(client: TestClient, asked: dict[str, Any]) -> Picture:
    answer = client.get("timeline", params=asked)
    assert answer.status_code == 200, answer.text
    head, arrays = unpacked(answer.content)
    lanes = [
        Lane(arrays[f"counts {n}"], arrays[f"gaps {n}"].reshape(-1, 2), one["exact"], one["period"])
        for n, one in enumerate(head["lanes"])
    ]
    return Picture(head, lanes, len(answer.content))


def test_gaps_are_those_of_queries(client: TestClient, demo_store: hl.Store, start: int) -> None:
    begin, end = 0, demo_store.session.look().summaries[0].extent[1] - start + 1
    found = picture(client, ["/r_cart/command_pose", "/imu/data", "/map"], begin, end, 2000)
    width = found.head["width"]
    wanted = list(demo_store.topic("/r_cart/command_pose").gaps())
    start += found.head["begin"]
    drawn = [(start + a * width, start + b * width) for a, b in found.lanes[0].gaps.tolist()]
    assert len(drawn) == len(wanted) > 1
    for (low, high), gap in zip(drawn, wanted, strict=True):
        # Whole bins without a message; at the ends of the recording bins reach out of it.
        assert gap.begin_ns - width < low <= gap.begin_ns + width
        assert gap.end_ns - width <= high < gap.end_ns + width
    assert [len(lane.gaps) for lane in found.lanes[1:]] == [0, 0]
    assert 9e6 < found.lanes[1].period < 11e6
    assert found.lanes[2].period == 0
    # Before and after the recording there is no gap.
    around = picture(client, ["/imu/data", "/r_cart/command_pose"], -end, 2 * end, 500)
    assert len(around.lanes[0].gaps) == 0
    origin, width = around.head["begin"], around.head["width"]
    drawn = [origin + number * width for number in around.lanes[1].gaps.ravel().tolist()]
    assert -width < drawn[0] <= 0
    assert end <= drawn[-1] < end + width


def cursor(page: Page) -> float:
    return float(page.locator(".density").get_attribute("aria-valuenow") or "nan") * SECOND


@pytest.mark.peer("browser")
def test_the_timeline_is_moved_and_zoomed(
    page: Page, demo_url: str, demo_store: hl.Store, start: int
) -> None:
    page.goto(f"{demo_url}#recording=robot&panels=[]")
    canvas = page.locator(".timeline .density")
    canvas.wait_for()
    box = canvas.bounding_box()
    assert box is not None
    length = demo_store.session.look().summaries[0].extent[1] - start + 1
    first = page.locator(".timeline .topic").first.inner_text()

    # A click sets the cursor; what the tip says is what the store counts.
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + 10)
    until(page, lambda: cursor(page) > 9 * SECOND)
    assert abs(cursor(page) - length / 2) < 2 * length / box["width"]
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 10)
    page.wait_for_selector(f".tip:has-text('{first}')")
    assert "in" in page.locator(".tip div").nth(2).inner_text()

    # A drag with Shift shows that range.
    page.keyboard.down("Shift")
    page.mouse.move(box["x"] + box["width"] / 4, box["y"] + 10)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 12)
    page.mouse.up()
    page.keyboard.up("Shift")
    until(page, lambda: page.evaluate("location.hash.includes('begin=')"))
    shown = hash_of(page)
    assert abs(shown["begin"] - length / 4) < 3 * length / box["width"]
    assert abs(shown["end"] - length / 2) < 3 * length / box["width"]

    # The wheel zooms around the pointer, a drag moves.
    around = shown["begin"] + (shown["end"] - shown["begin"]) / 4
    page.mouse.move(box["x"] + box["width"] / 4, box["y"] + 10)
    page.mouse.wheel(0, -300)
    until(page, lambda: page.evaluate(f"!location.hash.includes('begin={shown['begin']}')"))
    near = hash_of(page)
    span = near["end"] - near["begin"]
    assert span < 0.6 * (shown["end"] - shown["begin"])
    assert abs(near["begin"] + span / 4 - around) < span / 50
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 10, steps=4)
    page.mouse.up()
    until(page, lambda: page.evaluate(f"!location.hash.includes('begin={near['begin']}')"))
    moved = hash_of(page)
    assert abs(near["begin"] - moved["begin"] - span / 4) < span / 50
    assert abs(moved["end"] - moved["begin"] - span) <= 1

    page.keyboard.press("0")
    until(page, lambda: page.evaluate("!location.hash.includes('begin=')"))

    # A name opens a panel; the arrows go on to lanes that are out of sight.
    names = page.locator(".timeline .topic")
    names.first.focus()
    for _ in range(15):
        page.keyboard.press("ArrowDown")
    topic = page.evaluate("document.activeElement.textContent")
    assert page.evaluate("document.querySelector('.lanes').scrollTop") > 0
    page.keyboard.press("Enter")
    page.get_by_role("article", name=topic).wait_for()


@pytest.mark.peer("browser")
@pytest.mark.mongo("embedded")
def test_what_is_lost_is_said(page: Page, demo_store: hl.Store, tmp_path: Path) -> None:
    skipped = shutil.ignore_patterns("mongod*")
    shutil.copytree(demo_store.directory.path, tmp_path / "store", ignore=skipped)
    (entry,) = demo_store.recordings()
    chunks = demo_store.session.chunk_table(entry, 0).chunks
    chunk = chunks[len(chunks) // 2]
    path = places.segment(tmp_path / "store", "robot")
    flip(path, int(chunk["offset"]) + int(chunk["length"]) // 2, bits=0xFF)
    with hl.open(tmp_path / "store") as store:
        store.verify(repair=True)
        store.refresh()
        (loss,) = [loss for loss in store.entry("robot").losses if loss["count"]][:1]
        with served(store) as url:
            middle = (loss["from"] + loss["to"]) // 2 - store.entry("robot").span[0]
            page.goto(
                f"{url}#recording=robot&panels=[]&begin={middle - SECOND}&end={middle + SECOND}"
            )
            page.locator(".timeline .name", has_text=loss["topic"]).scroll_into_view_if_needed()
            lane, box = lane_of(page, loss["topic"])
            page.mouse.move(box["x"] + box["width"] / 2, lane["y"] + lane["height"] / 2)
            tip = page.locator(".tip")
            tip.filter(has_text=f"{loss['count']} lost ({loss['cause']}").wait_for()
            assert loss["topic"] in tip.inner_text()


def hash_of(page: Page) -> dict[str, int]:
    page.wait_for_timeout(300)  # the address is written when it has been still for a moment
    pairs = dict(pair.split("=") for pair in page.evaluate("location.hash.slice(1)").split("&"))
    return {key: int(pairs[key]) for key in ("begin", "end", "at") if key in pairs}
