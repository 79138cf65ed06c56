"""Points and tracks, asked by themselves and seen in a browser."""

from __future__ import annotations

import io
import json
import math
import struct
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from PIL import Image

import hybridlog as hl
from hybridlog_storage.messages import Channel, Schema
from tests.ros_values import ROS1
from tests.view.conftest import opened, served, until

if TYPE_CHECKING:
    from playwright.sync_api import Page

S = 10**9
BASE = 1_700_000_000 * S
RED, BLUE = 0xFF0000, 0x0000FF


def header(frame: str) -> Any:
    stamp = ROS1.types["builtin_interfaces/msg/Time"](1, 2)
    return ROS1.types["std_msgs/msg/Header"](0, stamp, frame)


def sent(topic: str, name: str, values: list[Any]) -> tuple[Channel, bytes]:
    full = f"sensor_msgs/msg/{name}"
    text = ROS1.generate_msgdef(full, ros_version=1)[0].encode()
    channel = Channel(topic, "ros1", Schema(f"sensor_msgs/{name}", "ros1msg", text))
    return channel, bytes(ROS1.serialize_ros1(ROS1.types[full](*values), full))


def scan(at: int) -> tuple[Channel, bytes]:
    ranges = np.array([1 + at, 2, np.inf, 50, np.nan, 4], np.float32)
    intensities = np.arange(6, dtype=np.float32) * 10
    values = [header("laser"), 0.0, math.pi, math.pi / 6, 0.0, 0.1, 0.1, 10.0, ranges, intensities]
    return sent("/scan", "LaserScan", values)


def cloud(topic: str, colour: int, *, cut: int = 0) -> tuple[Channel, bytes]:
    """A block of 20 x 20 x 2 points."""
    fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("rgb", 12, 6), ("ring", 16, 4)]
    grid = [(x / 10, y / 10, z) for x in range(20) for y in range(20) for z in (0.0, 1.0)]
    data = b"".join(struct.pack("<3fIH", *p, colour, n % 7) for n, p in enumerate(grid))
    described = [
        ROS1.types["sensor_msgs/msg/PointField"](name, at, kind, 1) for name, at, kind in fields
    ]
    raw = np.frombuffer(data[: len(data) - cut], np.uint8)
    values = [header("lidar"), 1, len(grid), described, False, 18, 18 * len(grid), raw, True]
    return sent(topic, "PointCloud2", values)


def fix(at: int) -> tuple[Channel, bytes]:
    """East by 7.5 m a second, then north; no fix from 10 to 12 s."""
    status = ROS1.types["sensor_msgs/msg/NavSatStatus"](-1 if 10 <= at < 13 else 0, 1)
    east, north = min(at, 15), max(at - 15, 0)
    covariance = np.array([4, 0, 0, 0, 1, 0, 0, 0, 9], np.float64)
    place = [48.0 + north * 1e-4, 11.0 + east * 1e-4, 500.0]
    return sent("/fix", "NavSatFix", [header("gps"), status, *place, covariance, 2])


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    with hl.open(tmp_path_factory.mktemp("spatial") / "store", create=True) as opened:
        with opened.start("yard") as recorder:
            for at in range(31):
                for channel, payload in (
                    fix(at),
                    *([scan(at)] if at < 3 else []),
                    *([cloud("/cloud", BLUE if at else RED)] if at < 2 else []),
                    *([cloud("/broken", RED, cut=3)] if not at else []),
                ):
                    recorder.write(channel, payload, log_time=BASE + at * S)
        yield opened


@pytest.fixture(scope="module")
def url(store: hl.Store) -> Iterator[str]:
    with served(store) as address:
        yield address


def data(page: Page, topic: str) -> dict[str, Any]:
    place = page.locator(f'article[aria-label$="{topic}"] .space')
    found: dict[str, Any] = place.evaluate("one => ({...one.dataset})")
    return found


def view(page: Page, kind: str) -> list[float]:
    text = page.locator(f"canvas.{kind}").get_attribute("data-view")
    return [float(part) for part in (text or "").split()]


@pytest.mark.peer("browser")
def test_a_scan_is_drawn(page: Page, url: str) -> None:
    opened(page, url, "yard", ("points", "/scan", {}), at=S)
    page.wait_for_selector(".space[data-points='3']")
    shown = data(page, "/scan")
    assert (shown["drawing"], shown["total"], shown["value"]) == ("flat", "6", "intensity")
    assert json.loads(shown["bounds"])["value"][:2] == [0, 50]
    words = page.locator(".facts").inner_text()
    assert words.startswith(
        "3 of 6 points · 2 not finite · 1 out of range · frame laser · +1.000 s"
    )
    # The point straight ahead, 2 m away, has the colour of the least intensity.
    before = view(page, "plane")
    assert colour_at(page, before, (2, 0))[2] > 150 > colour_at(page, before, (2, 0))[0]
    assert colour_at(page, before, (4 * math.cos(5 * math.pi / 6), 2))[0] > 150
    canvas = page.locator("canvas.plane")
    canvas.focus()
    canvas.press("+")
    canvas.press("ArrowRight")
    until(page, lambda: view(page, "plane")[0] > before[0])
    assert view(page, "plane")[2] == pytest.approx(before[2] * 1.25, rel=1e-4)
    canvas.press("0")
    until(page, lambda: view(page, "plane") == before)
    page.get_by_label("Colour by").select_option("one colour")
    page.wait_for_selector(".space[data-value='one colour']")
    until(page, lambda: "one+colour" in page.url)


def colour_at(page: Page, seen: list[float], place: tuple[float, float]) -> list[int]:
    script = """([right, up, scale, x, y]) => {
        const canvas = document.querySelector("canvas.plane");
        const { width, height } = canvas.getBoundingClientRect();
        const ratio = canvas.width / width;
        const at = [width / 2 + (x - right) * scale, height / 2 - (y - up) * scale];
        const [left, top] = at.map((pixel) => Math.round(pixel * ratio));
        return [...canvas.getContext("2d").getImageData(left, top, 1, 1).data].slice(0, 3);
    }"""
    found: list[int] = page.evaluate(script, [*seen, *place])
    return found


@pytest.mark.peer("browser")
def test_a_cloud_is_drawn_in_space(page: Page, url: str) -> None:
    opened(page, url, "yard", ("points", "/cloud", {}), at=0)
    page.wait_for_selector(".space[data-drawing='space']")
    shown = data(page, "/cloud")
    assert (shown["points"], shown["value"], shown["frame"]) == ("800", "rgb", "lidar")
    canvas = page.locator("canvas.scene")
    until(page, lambda: pixels(canvas.screenshot(), (255, 0, 0)) > 300)
    before = view(page, "scene")
    canvas.focus()
    canvas.press("ArrowLeft")
    canvas.press("t")
    until(page, lambda: view(page, "scene")[1] > 1.5)
    canvas.press("0")
    until(page, lambda: view(page, "scene") == before)
    # The next cloud takes its place in the same picture.
    page.evaluate("import('./state.js').then((state) => state.set({ at: 1e9 }))")
    page.wait_for_selector(f".space[data-time='{S}']")
    until(page, lambda: pixels(canvas.screenshot(), (0, 0, 255)) > 300)
    assert pixels(canvas.screenshot(), (255, 0, 0)) == 0
    assert view(page, "scene") == before
    page.get_by_role("button", name="From above").click()
    page.wait_for_selector(".space[data-drawing='flat']")
    page.get_by_role("button", name="In space").click()
    page.wait_for_selector(".space[data-drawing='space']")
    # Browsers take WebGL from a page that has many scenes.
    canvas.evaluate(
        "one => one.getContext('webgl2').getExtension('WEBGL_lose_context').loseContext()"
    )
    page.wait_for_selector(".space[data-drawing='flat']")
    assert "too much with WebGL: points are shown from above" in page.locator(".facts").inner_text()


def pixels(png: bytes, colour: tuple[int, int, int]) -> int:
    array = np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)
    return int((np.abs(array - colour).max(axis=2) < 40).sum())


@pytest.mark.peer("browser")
def test_a_track_is_drawn(page: Page, url: str) -> None:
    opened(page, url, "yard", ("map", "/fix", {}), at=2 * S)
    page.wait_for_selector(".space[data-fixes='28'][data-at]")
    shown = data(page, "/fix")
    assert (shown["points"], shown["messages"], shown["exact"]) == ("31", "31", "true")
    box = json.loads(shown["box"])
    assert (box["left"], box["bottom"]) == (0, 0)
    assert box["right"] == pytest.approx(111.92, abs=0.3)  # 15e-4 degrees at 48 degrees north
    assert json.loads(shown["at"]) == [pytest.approx(14.92, abs=0.05), 0]
    words = page.locator("article .sum").inner_text()
    assert "28 fixes · 3 messages without one" in words
    assert "48° N, 11.0002° E" in page.locator(".facts").inner_text()
    page.wait_for_timeout(100)
    seen = view(page, "plane")
    line, gap, ground = (colour_at(page, seen, (x, y)) for x, y in ((37, 0), (82, 0), (20, 33)))
    assert line != gap
    assert gap != ground  # the line of the grid
    # A click on the track moves the cursor there.
    canvas = page.locator("canvas.plane")
    box_of = canvas.bounding_box()
    assert box_of is not None
    x = box_of["width"] / 2 + (15 * 7.46 - seen[0]) * seen[2]
    y = box_of["height"] / 2 - (5 * 11.12 - seen[1]) * seen[2]
    canvas.click(position={"x": x, "y": y})
    there = pytest.approx(5 * 11.12, abs=0.1)
    until(page, lambda: json.loads(data(page, "/fix")["at"])[1] == there)
