"""A store of the demo's robot, its view, and a browser to look at it with."""

from __future__ import annotations

import io
import json
import os
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
import pytest
from starlette.testclient import TestClient

import hybridlog as hl
from benchmarks.simulator.topics import RobotConfig
from benchmarks.simulator.write import write_bag
from hybridlog.view.guard import Admission
from hybridlog.view.server import ViewServer, make_app
from tests.every_image import write_images
from tests.odd_messages import write_odd
from tests.view.chromium import Chromium, chromium

if TYPE_CHECKING:
    from playwright.sync_api import Browser, ConsoleMessage, FloatRect, Page

TOKEN, PORT = "a-token", 4242
ROBOT = RobotConfig(image_size=(64, 48), scan_beams=180, cloud_columns=60)

Asking = Callable[[hl.Store], TestClient]


@pytest.fixture(scope="session")
def demo_store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    """An open store with 20 seconds of the demo's robot as `robot`. Tests only read it."""
    place = tmp_path_factory.mktemp("view")
    write_bag(place / "robot.bag", duration_s=20, config=ROBOT)
    with hl.open(place / "store", create=True) as store:
        store.record(place / "robot.bag", name="robot", tags={"place": "lab"})
        yield store


@pytest.fixture(scope="session")
def start(demo_store: hl.Store) -> int:
    """The first log time of `demo_store`."""
    (entry,) = demo_store.recordings()
    assert entry.span is not None
    return entry.span[0]


@pytest.fixture(scope="session")
def asking() -> Asking:
    """Makes a client of the view of a store, without a server; paths are below the token."""

    def client(store: hl.Store) -> TestClient:
        app = make_app(store, Admission(token=TOKEN, port=PORT))
        return TestClient(app, base_url=f"http://127.0.0.1:{PORT}/{TOKEN}/")

    return client


@pytest.fixture(scope="session")
def client(demo_store: hl.Store, asking: Asking) -> TestClient:
    """A client of the view of `demo_store`."""
    return asking(demo_store)


@pytest.fixture(scope="session")
def odd_store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    """An open store with the recordings `odd` and `images`. Tests only read it."""
    with hl.open(tmp_path_factory.mktemp("odd") / "store", create=True) as store:
        write_odd(store)
        write_images(store)
        yield store


@pytest.fixture(scope="session")
def odd(odd_store: hl.Store, asking: Asking) -> TestClient:
    """A client of the view of `odd_store`."""
    return asking(odd_store)


def printed_by(program: str) -> str:
    """What a program prints that the page has given."""
    said = io.StringIO()
    names: dict[str, Any] = {"__name__": "copied"}
    with redirect_stdout(said):
        exec(compile(program, "copied", "exec"), names)
    if "store" in names:
        names["store"].close()
    return said.getvalue()


def unpacked(body: bytes) -> tuple[dict[str, Any], dict[str, Any]]:
    """Header and arrays of an answer."""
    (size,) = struct.unpack_from("<I", body)
    found = json.loads(body[4 : 4 + size])
    arrays, place = {}, 4 + size
    for one in found["arrays"]:
        kind = np.dtype(one["type"])
        assert place % kind.itemsize == 0
        arrays[one["name"]] = np.frombuffer(body, kind, one["count"], place)
        place += kind.itemsize * one["count"]
    assert place == len(body)
    return found, arrays


@contextmanager
def served(store: hl.Store) -> Iterator[str]:
    """Serve the view of a store; gives its address."""
    server = ViewServer(store)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        yield server.url
    finally:
        server.stop()
        thread.join()


@pytest.fixture(scope="session")
def demo_url(demo_store: hl.Store) -> Iterator[str]:
    """Address of the view of `demo_store`."""
    with served(demo_store) as url:
        yield url


@pytest.fixture(scope="session")
def odd_url(odd_store: hl.Store) -> Iterator[str]:
    """Address of the view of `odd_store`."""
    with served(odd_store) as url:
        yield url


@pytest.fixture(scope="session")
def installed() -> Chromium:
    """Where chromium lies. Tests that use it are marked `@pytest.mark.peer("browser")`."""
    found = chromium()
    if isinstance(found, str):
        pytest.skip(f"The page was NOT tested in a browser, {found}: apt-get install chromium")
    return found


@pytest.fixture(scope="package")
def browser(installed: Chromium) -> Iterator[Browser]:
    """A real browser. Tests that use it are marked `@pytest.mark.peer("browser")`.

    While it is open, an event loop runs in this thread, so tests of this folder can have none.
    """
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        started = playwright.chromium.launch(
            executable_path=installed.path,
            env=installed.environment or dict(os.environ),
            args=["--no-sandbox", "--enable-unsafe-swiftshader"],
        )
        yield started
        started.close()


@pytest.fixture
def page(browser: Browser) -> Iterator[Page]:
    """An empty page; the test fails if a script fails or writes an error to the console."""
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    context.set_default_timeout(15_000)
    opened = context.new_page()
    problems: list[str] = []
    opened.on("pageerror", lambda error: problems.append(str(error)))

    def heard(said: ConsoleMessage) -> None:
        # The browser itself writes that of every question that the server refuses.
        if said.type == "error" and not said.text.startswith("Failed to load resource"):
            problems.append(said.text)

    opened.on("console", heard)
    yield opened
    context.close()
    assert not problems


def lane_of(page: Page, topic: str) -> tuple[FloatRect, FloatRect]:
    """Where a lane's name and the picture lie; asked again while the lanes are made anew."""
    row = page.locator(".timeline .name").filter(has_text=topic).first
    for _ in range(60):
        if (lane := row.bounding_box()) and (box := page.locator(".density").bounding_box()):
            return lane, box
        page.wait_for_timeout(50)
    raise AssertionError(f"no lane of {topic}")


def until(page: Page, holds: Callable[[], object]) -> None:
    """Wait for something in a page whose policy refuses `wait_for_function`."""
    for _ in range(750):
        if holds():
            return
        page.wait_for_timeout(20)
    raise AssertionError("it never came")


def opened(
    page: Page, url: str, recording: str, *panels: tuple[str, str, Any], at: int = 0
) -> None:
    """Open a recording with some panels: kind, topic and options."""
    shown = [{"kind": k, "topic": t, "options": options} for k, t, options in panels]
    page.goto("about:blank")
    page.goto(f"{url}#recording={recording}&at={at}&panels={quote(json.dumps(shown))}")
    page.wait_for_selector(".panels > article")
