"""Panels in a browser, against values from the store."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import hybridlog as hl
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.every_image import HEIGHT, RAW, WIDTH
from tests.odd_messages import HOSTILE, LOGS, LONG, MS, START, log_time
from tests.view.conftest import opened, printed_by, served

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page

pytestmark = pytest.mark.peer("browser")
S = 10**9
SHOWN = "text => document.querySelector('.picture img')?.alt === text"


def seek(page: Page, at: int) -> None:
    page.evaluate("async at => (await import('./state.js')).set({ at })", at)


def state(page: Page, key: str) -> Any:
    return page.evaluate("async key => (await import('./state.js')).get(key)", key)


def panel(page: Page, kind: str) -> Locator:
    return page.locator(f"article.panel.{kind}")


def test_a_message_as_a_tree(page: Page, odd_url: str) -> None:
    opened(page, odd_url, "odd", ("message", "/own", {}), at=3 * S)
    tree = panel(page, "message").locator(".tree")

    def shown(name: str) -> str:
        own = page.locator(".name").get_by_text(name, exact=True)
        return tree.locator(".leaf", has=own).locator(".value").inner_text()

    tree.get_by_text("name 3").wait_for()
    assert shown("id") == "18446744073709551612"
    assert shown("took") == "-2.5 s"
    seek(page, 5 * S)
    tree.get_by_text("name 7").wait_for()  # the last of three at that time
    # A long array: parts of it, and none of the rest.
    data = tree.locator("details details", has_text="uint8[")
    numbers = data.locator(".numbers").first
    assert numbers.inner_text().split() == [str(k * 7 % 256) for k in range(64)]
    data.get_by_text(f"elements 0 to 63 of {LONG:,}").wait_for()
    data.get_by_label("Later elements").click()
    data.get_by_text(f"elements 64 to 163 of {LONG:,}").wait_for()
    assert numbers.inner_text().split() == [str(k * 7 % 256) for k in range(64, 164)]
    # The next message is shown on the same page, and what was closed stays closed.
    name = page.locator("summary .name").get_by_text("path", exact=True)
    path = tree.locator("details details", has=name)
    path.locator("summary").first.focus()
    page.keyboard.press("Enter")
    seek(page, 2 * S)
    tree.get_by_text("name 2").wait_for()
    data.get_by_text(f"elements 64 to 163 of {LONG:,}").wait_for()
    assert path.get_attribute("open") is None
    assert json.loads(json.dumps(state(page, "panels")))[0]["options"] == {"toggled": ["path"]}
    # One that is damaged is told, and the next one is shown again.
    seek(page, 6 * S)
    page.get_by_role("alert").get_by_text("cannot be read").wait_for()
    seek(page, 0)
    tree.get_by_text("name 0").wait_for()
    seek(page, -S)
    tree.get_by_text("No message at or before the cursor").wait_for()


def test_hostile_names_and_values_are_text(page: Page, odd_url: str) -> None:
    kinds = [("message", "/loose", {}), ("message", HOSTILE, {}), ("log", HOSTILE, {})]
    opened(page, odd_url, "odd", *kinds, ("plot", HOSTILE, {}), at=0)
    page.get_by_text("<script>alert(1)</script>").wait_for()
    page.get_by_role("heading", name=HOSTILE).first.wait_for()
    panel(page, "log").locator(".line").first.wait_for()
    assert page.locator("article img, article script, article b").count() == 0
    assert page.title().startswith("odd ")


def test_a_plot(page: Page, demo_store: hl.Store, start: int, demo_url: str) -> None:
    fields = ["twist.twist.linear.x", "pose.pose.position.y"]
    page.set_viewport_size({"width": 460, "height": 1000})  # fewer pixels than messages
    opened(page, demo_url, "robot", ("plot", "/odom", {"fields": fields}), at=7 * S)
    plot = panel(page, "plot")
    chart = plot.locator(".chart")
    query = demo_store.topic("/odom")

    def values() -> list[str]:
        return plot.locator("output").all_inner_texts()

    page.wait_for_selector(".chart[data-exact=false]")
    box = chart.locator(".u-over").bounding_box()
    assert box is not None
    # A drag over the plot zooms everything; a click moves the cursor.
    page.mouse.move(box["x"] + box["width"] * 0.5, box["y"] + 20)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * 0.6, box["y"] + 25, steps=4)
    page.mouse.up()
    page.wait_for_selector(".chart[data-exact=true]")
    begin, end = state(page, "begin"), state(page, "end")
    length = demo_store.session.look().summaries[0].extent[1] - start
    assert begin == pytest.approx(0.5 * length, rel=0.01)
    assert end == pytest.approx(0.6 * length, rel=0.01)
    assert state(page, "at") == 7 * S
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + 30)
    at = state(page, "at")
    assert at == pytest.approx((begin + end) / 2, abs=length * 0.001)
    page.mouse.move(0, 0)
    # Values at the cursor are those of the message that is current there.
    message = query.at(start + at).decode()
    wanted = [message.twist.twist.linear.x, message.pose.pose.position.y]
    page.wait_for_function("() => document.querySelector('output').textContent !== ''")
    assert [float(text) for text in values()] == pytest.approx(wanted, rel=1e-5)
    # And below the mouse, those of the message that is nearest.
    page.mouse.move(box["x"] + box["width"] * 0.25, box["y"] + 40)
    hovered = begin + (end - begin) * 0.25
    times = query.to_arrow()["log_time"].cast("int64").to_numpy() - start
    nearest = query.at(int(times[np.abs(times - hovered).argmin()]) + start).decode()
    assert float(values()[1]) == pytest.approx(nearest.pose.pose.position.y, rel=1e-5)
    page.mouse.dblclick(box["x"] + 50, box["y"] + 30)
    page.wait_for_selector(".chart[data-exact=false]")
    assert state(page, "begin") is None


def test_a_log(page: Page, odd_url: str) -> None:
    opened(page, odd_url, "odd", ("log", "/rosout", {}), at=log_time(100) - START)
    log = panel(page, "log")
    log.get_by_text(f"{len(LOGS) + 1} lines").wait_for()
    current = log.locator("[aria-current=true]")
    assert "line 104 " in current.inner_text()  # the last one at that time
    assert current.locator(".level").inner_text() == "fatal"
    assert log.locator(".whole").inner_text() == LOGS[104][2]
    assert log.locator(".line").count() < 60
    # A click on a line moves the cursor, and so do the arrows.
    log.locator(".line", has_text="line 107 ").click()
    assert state(page, "at") == log_time(107) - START
    log.get_by_label("Lines", exact=True).focus()
    page.keyboard.press("ArrowUp")
    assert state(page, "at") == log_time(104) - START
    # To both ends, page by page; what cannot be read is told in its place.
    lines = log.get_by_label("Lines", exact=True)
    for end, text in (("0", "line 0 "), ("1e9", "cannot be read")):
        for _ in range(3):
            lines.evaluate(f"one => one.scrollTop = {end}")
            page.wait_for_timeout(60)
        log.locator(".line", has_text=text).first.wait_for()
    # Filters.
    log.get_by_label("Least level").select_option("error")
    log.get_by_label("Text", exact=True).fill("LINE 1")
    wanted = [text for level, _, text in LOGS if level >= 3 and "line 1" in text]
    log.get_by_text(f"{len(wanted)} lines").wait_for()
    lines.evaluate("one => one.scrollTop = 0")
    log.locator(".line", has_text=wanted[0].splitlines()[0]).wait_for()
    assert state(page, "panels")[0]["options"] == {"level": "error", "text": "LINE 1"}


def test_play_never_queues_requests(
    page: Page, demo_url: str, demo_store: hl.Store, start: int
) -> None:
    """The cursor runs at ten times; each panel has one request under way, and ends exact."""
    topics = [("image", "/camera/front/image_raw", {}), ("message", "/imu/data", {})]
    opened(page, demo_url, "robot", *topics, at=S)
    page.locator(".picture img").wait_for()
    page.wait_for_load_state("networkidle")  # the lanes have come, too
    found = page.evaluate(
        """async () => {
          const state = await import("./state.js");
          const real = window.fetch;
          let [running, most, asked] = [0, 0, 0];
          window.fetch = async (...parts) => {
            asked += 1;
            most = Math.max(most, (running += 1));
            try { return await real(...parts); } finally { running -= 1; }
          };
          const place = document.querySelector(".picture");
          let blank = 0;
          const watch = new MutationObserver(() => {
            const image = place.querySelector("img");
            if (!image || !image.complete || !image.naturalWidth) blank += 1;
          });
          watch.observe(place, { childList: true });
          for (let step = 1; step <= 60; step += 1) {
            state.set({ at: step * 166e6 });
            await new Promise(requestAnimationFrame);
          }
          window.fetch = real;
          watch.disconnect();
          return { most, asked, blank };
        }"""
    )
    assert found["most"] <= len(topics)
    assert found["asked"] > 2 * len(topics)
    assert found["blank"] == 0  # a picture is decoded before it takes the place of another one
    at = start + 60 * 166 * MS
    image = demo_store.topic("/camera/front/image_raw").at(at)
    alt = f"/camera/front/image_raw at +{(image.log_time_ns - start) / 1e9:.3f} s"
    page.wait_for_function(SHOWN, arg=alt)
    message = demo_store.topic("/imu/data").at(at)
    panel(page, "message").get_by_text(
        str(message.decode().header.seq), exact=True
    ).first.wait_for()


def test_copied_python_runs(page: Page, odd_url: str, odd_store: hl.Store) -> None:
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    kinds = [
        ("message", "/own", {}),
        ("plot", "/own", {"fields": ["id", "axis[0]"]}),
        ("log", HOSTILE, {"text": "line 1"}),
        ("log", "/rosout", {"level": "error"}),
    ]
    opened(page, odd_url, "odd", *kinds, at=3 * S)
    told = copied(page)
    assert "18446744073709551612" in told[0]
    assert "axis" in told[1]
    assert told[2].count("\n") == sum("line 1" in text for _, _, text in LOGS)
    assert told[3].count("\n") == sum(level >= 3 for level, _, _ in LOGS)
    opened(page, odd_url, "images", ("image", RAW, {}))
    assert f"({HEIGHT}, {WIDTH})" in copied(page)[0]


def copied(page: Page) -> list[str]:
    found = []
    for button in page.get_by_role("button", name="Copy as Python").all():
        page.evaluate("navigator.clipboard.writeText('')")
        button.click()
        page.wait_for_function("async () => await navigator.clipboard.readText() !== ''")
        found.append(printed_by(page.evaluate("navigator.clipboard.readText()")))
    return found


def test_a_recording_that_goes_on(page: Page, tmp_path: Path) -> None:
    begun = time.time_ns()  # before messages are sealed, times count from about now
    said = Channel("/said", "json", Schema("foxglove.Log", "jsonschema", b"{}"))
    other = Channel("/other", "json", None)

    def write(channel: Channel, numbers: range) -> None:
        for n in numbers:
            text = json.dumps({"level": 2, "message": f"said {n}", "n": n}).encode()
            recording.write(channel, text, log_time=begun + n * S)

    with (
        hl.open(tmp_path / "store", create=True, mongo="none") as writing,
        writing.start("ended") as ended,
        writing.start(
            "live",
            flush_interval_s=0.05,
            settings=SegmentSettings(chunk_size=1024, segment_size=2000),
        ) as recording,
        hl.open(tmp_path / "store", mongo="none") as store,
    ):
        ended.write(said, b"{}", log_time=S)
        ended.close()
        write(said, range(10))
        kinds = [("message", "/said", {}), ("log", "/said", {}), ("plot", "/said", {})]
        with served(store) as url:
            page.goto(url)
            # The newest first, although none of its messages is sealed.
            page.get_by_role("link", name="ended").wait_for()
            assert "live" in page.locator("tbody tr").first.inner_text()
            opened(page, url, "live", *kinds)
            panel(page, "log").get_by_text("10 lines").wait_for()
            page.wait_for_selector("text=being recorded")
            write(said, range(10, 30))
            write(other, range(7))
            panel(page, "log").get_by_text("30 lines").wait_for()
            # The cursor was at the end, and stays there.
            panel(page, "log").locator("[aria-current=true]", has_text="said 29").wait_for()
            panel(page, "message").get_by_text("said 29").wait_for()
            output = panel(page, "plot").locator("output[data-field=n]")
            output.get_by_text("29", exact=True).wait_for()
            lanes = page.locator(".timeline .name")
            lanes.filter(has_text="/said").filter(has_text="30").wait_for()
            lanes.filter(has_text="/other").filter(has_text="7").wait_for()
            menu = page.get_by_label("Topic of the question")
            menu.locator("option", has_text="/other").wait_for(state="attached")
            assert menu.input_value() == "/said"
            seek(page, state(page, "at") - 24 * S)
            panel(page, "message").get_by_text("said 5").wait_for()
            output.get_by_text("5", exact=True).wait_for()
            recording.close()
            page.wait_for_selector("text=being recorded", state="detached")
            page.wait_for_selector("text=37 messages")
