"""The timeline against what queries answer, by itself and seen in a browser."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest

import hybridlog as hl
from hybridlog.live import LiveRecording
from hybridlog_storage.messages import Channel
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.damage import flip
from tests.view.conftest import Asking, lane_of, served, unpacked
from tests.waiting import wait_for

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


A, B = (Channel(name, "json", None) for name in ("/a", "/b"))
SETTINGS = SegmentSettings(chunk_size=4096, segment_size=30_000, compression="none")


@pytest.fixture
def running(tmp_path: Path) -> Iterator[tuple[LiveRecording, hl.Store]]:
    """A recording that goes on, and the store as another process has it open."""
    with (
        hl.open(tmp_path / "store", create=True) as writing,
        writing.start("live", settings=SETTINGS, flush_interval_s=0.05) as recording,
        hl.open(tmp_path / "store") as store,
    ):
        yield recording, store


def write(recording: LiveRecording, channel: Channel, begin: int, count: int) -> None:
    for n in range(begin, begin + count):
        recording.write(channel, b'{"n": 1}', log_time=SECOND * SECOND + n * SECOND // 100)


@pytest.mark.peer("browser")
def test_a_recording_that_goes_on_is_followed(
    running: tuple[LiveRecording, hl.Store], page: Page, asking: Asking
) -> None:
    recording, store = running
    client = asking(store)

    def live() -> dict[str, Any]:
        answer = client.get("recording", params={"recording": "live"})
        assert answer.status_code == 200, answer.text
        found: dict[str, Any] = answer.json()
        return found

    write(recording, A, 0, 50)
    wait_for(lambda: live()["messages"] == 50)
    (topic,) = live()["topics"]
    assert (topic["topic"], topic["messages"]) == ("/a", 50)
    assert topic["last"] == str(49 * SECOND // 100)
    with served(store) as url:
        page.goto(f"{url}#recording=live&panels=[]")
        page.wait_for_selector("text=being recorded")
        row = page.locator(".timeline .name")
        row.filter(has_text="/a").filter(has_text="50").wait_for()
        write(recording, A, 50, 1000)  # several segments
        write(recording, B, 1050, 50)
        wait_for(lambda: live()["messages"] == 1100)
        assert live()["status"] == "open"
        page.wait_for_selector("text=1,100 messages")
        row.filter(has_text="/b").filter(has_text="50").wait_for()
        menu = page.get_by_label("Topic of the question")
        menu.locator("option", has_text="/b").wait_for(state="attached")
        assert menu.evaluate("menu => [...menu.options].map(one => one.value)") == ["/a", "/b"]
        assert menu.input_value() == "/a"
        # The cursor was at the end, and stays there.
        until(page, "document.querySelector('.readout').textContent.length > 0")
        at = json.loads(page.locator(".density").get_attribute("aria-valuenow") or "null")
        assert at == pytest.approx((int(live()["end"]) - 1) / SECOND)
        recording.close()
        page.wait_for_selector("text=being recorded", state="detached")
        ended = live()
        assert ended["status"] == "complete"

    store.mark("live", "+2s", "look <b>here</b>")
    store.refresh()
    marks = client.get("recording", params={"recording": "live"}).json()["marks"]
    assert marks == [{"at": 2 * SECOND, "end": 2 * SECOND, "text": "look <b>here</b>"}]


def until(page: Page, condition: str) -> None:
    """Wait for something in a page whose policy refuses `wait_for_function`."""
    end = time.monotonic() + 15
    while not page.evaluate(condition):
        assert time.monotonic() < end, condition
        page.wait_for_timeout(20)


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
    until(page, "Number(document.querySelector('.density').ariaValueNow) > 9")
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
    until(page, "location.hash.includes('begin=')")
    shown = hash_of(page)
    assert abs(shown["begin"] - length / 4) < 3 * length / box["width"]
    assert abs(shown["end"] - length / 2) < 3 * length / box["width"]

    # The wheel zooms around the pointer, a drag moves.
    around = shown["begin"] + (shown["end"] - shown["begin"]) / 4
    page.mouse.move(box["x"] + box["width"] / 4, box["y"] + 10)
    page.mouse.wheel(0, -300)
    until(page, f"!location.hash.includes('begin={shown['begin']}')")
    near = hash_of(page)
    span = near["end"] - near["begin"]
    assert span < 0.6 * (shown["end"] - shown["begin"])
    assert abs(near["begin"] + span / 4 - around) < span / 50
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 10, steps=4)
    page.mouse.up()
    until(page, f"!location.hash.includes('begin={near['begin']}')")
    moved = hash_of(page)
    assert abs(near["begin"] - moved["begin"] - span / 4) < span / 50
    assert abs(moved["end"] - moved["begin"] - span) <= 1

    page.keyboard.press("0")
    until(page, "!location.hash.includes('begin=')")

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
            lane, box = lane_of(page, loss["topic"])
            page.mouse.move(box["x"] + box["width"] / 2, lane["y"] + lane["height"] / 2)
            tip = page.locator(".tip")
            tip.filter(has_text=f"{loss['count']} lost ({loss['cause']}").wait_for()
            assert loss["topic"] in tip.inner_text()


def hash_of(page: Page) -> dict[str, int]:
    page.wait_for_timeout(300)  # the address is written when it has been still for a moment
    pairs = dict(pair.split("=") for pair in page.evaluate("location.hash.slice(1)").split("&"))
    return {key: int(pairs[key]) for key in ("begin", "end", "at") if key in pairs}
