"""The page in a browser, at three widths, light and dark: what is seen by who looks for faults."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import hybridlog as hl
from hybridlog.view.guard import token_of
from hybridlog.view.server import ViewServer
from hybridlog_storage.errors import UsageError
from tests.odd_messages import LOGS, START, log_time
from tests.test_keep import BEGIN, COUNT, SECOND, record
from tests.view.conftest import lane_of, opened, served

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

LOOKS = [(width, scheme) for width in (1440, 760, 390) for scheme in ("light", "dark")]
LENGTH = 6 * SECOND  # of the recording `odd`
PICTURES = os.environ.get("HYBRIDLOG_PICTURES")
"""A folder for pictures of what the tests see, for people."""


def seen_at(width: int, scheme: str) -> pytest.MarkDecorator:
    """A test of a page that looks like this, and of all others on demand."""
    looks = [
        one if one == (width, scheme) else pytest.param(one, marks=pytest.mark.exhaustive)
        for one in LOOKS
    ]
    return pytest.mark.parametrize("look", looks, indirect=True, ids=str)


@pytest.fixture
def look(request: pytest.FixtureRequest, browser: Browser) -> Iterator[Page]:
    """An empty page of some width, light or dark; nothing in it is wider than it."""
    width, scheme = request.param
    context = browser.new_context(
        viewport={"width": width, "height": 900}, color_scheme=scheme, has_touch=width < 400
    )
    context.set_default_timeout(15_000)
    page = context.new_page()
    problems: list[str] = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    yield page
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    if PICTURES:
        page.screenshot(path=f"{PICTURES}/{request.node.name}.png", full_page=True)
    context.close()
    assert not problems


def tip_at(page: Page, topic: str, share: float) -> str:
    """What the timeline says of a lane at a share of its width."""
    lane, box = lane_of(page, topic)
    page.mouse.move(box["x"] + box["width"] * share, lane["y"] + lane["height"] / 2)
    return page.locator(".tip").inner_text()


def said(page: Page, topic: str, share: float, text: str) -> None:
    """Wait until the timeline says something of a lane."""
    for _ in range(60):
        if text in tip_at(page, topic, share):
            return
        page.wait_for_timeout(150)
    raise AssertionError(tip_at(page, topic, share))


def colours(page: Page, topic: str, begin: float, end: float) -> set[tuple[int, ...]]:
    """The colours of a lane between two shares of its width."""
    lane, box = lane_of(page, topic)
    top, bottom = lane["y"] - box["y"] + 2, lane["y"] - box["y"] + lane["height"] - 4
    found: list[list[int]] = page.locator(".density").evaluate(
        """(canvas, [begin, end, top, bottom]) => {
          const [ratio, wide] = [devicePixelRatio, canvas.width];
          const place = [begin * wide, top * ratio, (end - begin) * wide, (bottom - top) * ratio];
          const { data } = canvas.getContext("2d").getImageData(...place.map(Math.round));
          const seen = new Set();
          for (let n = 0; n < data.length; n += 4)
            if (data[n + 3] > 60) seen.add(data.slice(n, n + 3).join());
          return [...seen].map((one) => one.split(",").map(Number));
        }""",
        [begin, end, top, bottom],
    )
    return {tuple(one) for one in found}


@pytest.mark.peer("browser")
@seen_at(1440, "light")
def test_what_others_change_is_seen(look: Page, tmp_path: Path) -> None:
    """Marks, what expires, and what is lost: on a page that is open, and after a reload."""
    path = tmp_path / "store"
    with hl.open(path, mongo="none", create=True) as store:
        record(store)
    with hl.open(path, mongo="none") as shown, served(shown) as url:
        opened(look, url, "run", ("message", "/camera", {}), at=5 * SECOND)
        look.locator(".tree .leaf", has_text="n5").first.wait_for()
        before = colours(look, "/camera", 0.02, 0.1)
        with hl.open(path, mongo="none") as other:
            other.mark("run", BEGIN + 60 * SECOND, "<b>slipped</b>")
            other.edit("run", tag={"seen": "yes"})
            other.keep({"quota": "400KB"})
            (kept, *_) = [m.fields["n"] for m in other.topic("/camera") if not m.is_reduced]
        assert 10 < kept < COUNT
        said(look, "/camera", 60.5 / COUNT, "Mark: <b>slipped</b>")
        said(look, "/camera", 5.5 / COUNT, "Payloads have expired: only fields are here")
        look.get_by_text("seen=yes").wait_for()
        assert "Gap" not in tip_at(look, "/camera", 5.5 / COUNT)
        assert "lost" not in tip_at(look, "/camera", 5.5 / COUNT)
        assert "expired" not in tip_at(look, "/camera", 0.98)
        look.mouse.move(0, 0)
        # The panel says it, not as an error, and without names of files.
        look.locator(".facts", has_text="its payload was deleted to make room").wait_for()
        assert look.get_by_role("alert").count() == 0
        assert colours(look, "/camera", 0.02, 0.1) > before, "a mark of its own"
        # Files that are deleted are closed, so that the disk gets their room back.
        held = [str(one.resolve()) for one in Path("/proc/self/fd").iterdir()]
        assert not [one for one in held if one.startswith(str(path)) and "deleted" in one]
        look.reload()
        said(look, "/camera", 5.5 / COUNT, "Payloads have expired")
        look.locator(".facts", has_text="its payload was deleted to make room").wait_for()


@pytest.mark.peer("browser")
@seen_at(390, "light")
def test_trouble_is_on_its_lane(look: Page, odd_url: str) -> None:
    """Lines of a log at WARN and above are ticks on its lane, which comes first."""
    opened(look, odd_url, "odd", ("log", "/rosout", {}))
    first = look.locator(".timeline .topic").first.inner_text()
    assert first in {"/fox", "/rosout", "/rosout2"}
    times = [log_time(n) - START for n, (level, *_) in enumerate(LOGS) if level >= 2]
    said(look, "/rosout", times[len(times) // 2] / LENGTH, "Warnings and errors")
    # A text is not cut: the panel scrolls.
    line = look.locator(".line .text").first
    line.wait_for()
    assert line.evaluate("one => getComputedStyle(one).textOverflow") == "clip"


@pytest.mark.peer("browser")
@seen_at(760, "dark")
def test_lanes_are_filtered_and_all_are_reached_by_keyboard(look: Page, demo_url: str) -> None:
    look.goto(f"{demo_url}#recording=robot&panels=[]")
    names = look.locator(".timeline .topic")
    names.first.wait_for()
    names.first.focus()
    topics = [look.evaluate("document.activeElement.textContent")]
    while True:
        look.keyboard.press("ArrowDown")
        name = look.evaluate("document.activeElement.textContent")
        if name == topics[-1]:
            break
        topics.append(name)
    assert len({*topics}) == 18
    look.get_by_label("Filter of the lanes").fill("camera image")
    look.locator(".timeline .name").nth(1).wait_for()
    look.wait_for_function("document.querySelectorAll('.timeline .topic').length === 2")
    assert names.all_inner_texts() == ["/camera/front/image_raw", "/camera/rear/image_raw"]
    said(look, "/camera/rear/image_raw", 0.5, "/camera/rear/image_raw")


@pytest.mark.peer("browser")
@seen_at(390, "dark")
def test_the_first_view_has_something(look: Page, demo_url: str) -> None:
    """Each panel shows a message, the map more than a dot; a plot begins with what moves."""
    look.goto(f"{demo_url}#recording=robot")
    look.locator(".panel .picture img").wait_for()
    look.wait_for_selector(".panel.points .space[data-points]")
    box = look.locator(".panel.map .space[data-box]")
    box.wait_for()
    found: dict[str, float] = box.evaluate("one => JSON.parse(one.dataset.box)")
    assert found["top"] - found["bottom"] > 4
    look.locator(".panel.log .line[aria-current]").wait_for()
    for topic, fixed in (("/odom", "pose.pose.position.z"), ("/imu/data", "header.seq")):
        opened(look, demo_url, "robot", ("plot", topic, {}))
        look.locator(".chip .name").first.wait_for()
        names = look.locator(".chip .name").all_inner_texts()
        assert 1 <= len(names) <= 3
        assert fixed not in names
    opened(look, demo_url, "robot", ("plot", "/odom", {"fields": ["header.stamp"]}))
    look.wait_for_selector(".chart[data-exact]")
    room = look.evaluate(
        "getComputedStyle(document.querySelector('.u-over')).left.replace('px', '')"
    )
    assert float(room) >= 20 + 7 * len("1,748,937,600,000,000,000"), "labels are whole"


@pytest.mark.peer("browser")
@seen_at(1440, "light")
def test_a_link_stays_right_after_a_restart(
    look: Page, demo_store: hl.Store, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    from threading import Thread

    file, port, url = tmp_path / "token", 0, ""
    for _ in range(2):
        server = ViewServer(demo_store, port, token_of(file))
        thread = Thread(target=server.run)
        thread.start()
        try:
            assert url in {"", server.url}
            port, url = server.port, server.url
            answers: list[int] = []
            look.on("response", lambda one: answers.append(one.status))  # noqa: B023
            if look.url == "about:blank":
                look.goto(f"{url}#recording=robot&at=5000000000")
            else:
                look.reload()
            look.get_by_text("+5.000000000 s").wait_for()
        finally:
            server.stop()
            thread.join()
    assert 304 in answers, "files that have not changed are not sent again"
    assert stat.S_IMODE(file.stat().st_mode) == 0o600


def test_a_token_is_for_its_owner_alone(tmp_path: Path) -> None:
    file = tmp_path / "token"
    token = token_of(file)
    assert token_of(file) == token
    file.chmod(0o644)
    with pytest.raises(UsageError, match="chmod 600"):
        token_of(file)
    file.chmod(0o600)
    for text in ("", "short", "a/b" * 9, "é" * 20):
        file.write_text(text)
        with pytest.raises(UsageError, match="token"):
            token_of(file)
    with pytest.raises(UsageError, match="No token"):
        token_of(tmp_path)
