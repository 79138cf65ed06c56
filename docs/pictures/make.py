"""Takes the picture of `hybridlog view` in the README: `python docs/pictures/make.py`.

It records the demo bag, and looks at the store with chromium.
"""

from __future__ import annotations

import argparse
import io
import shutil
import tempfile
import threading
from pathlib import Path
from typing import Final
from urllib.parse import urlencode

from PIL import Image
from playwright.sync_api import sync_playwright

import hybridlog as hl
from hybridlog.view.server import ViewServer

BAG: Final = Path(hl.__file__).parent / "demo" / "robot.bag"
SIZE: Final = {"width": 1360, "height": 850}
QUESTION: Final = '{"kind":"predicate","topic":"/base/scan","text":"ranges.min < 0.5","within":""}'


def look(store: hl.Store, browser: str, output: Path) -> None:
    """Take the picture of a store's first recording, at its nearest obstacle.

    Args:
        store: An open store of the demo bag.
        browser: Path of chromium.
        output: The PNG file.
    """
    (entry,) = store.recordings()
    assert entry.span is not None
    near = next(iter(store.topic("scan").where("ranges.min < 0.5")))
    state = {
        "recording": entry.name,
        "at": near.log_time_ns - entry.span[0],
        "ask": QUESTION,
    }
    server = ViewServer(store)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        with sync_playwright() as playwright:
            chromium = playwright.chromium.launch(
                executable_path=browser, args=["--no-sandbox", "--enable-unsafe-swiftshader"]
            )
            page = chromium.new_page(viewport=SIZE, device_scale_factor=1.5)  # type: ignore[arg-type]
            page.goto(f"{server.url}#{urlencode(state)}")
            page.wait_for_load_state("networkidle")
            page.wait_for_timeout(1000)  # the points are drawn with the next frames
            picture = Image.open(io.BytesIO(page.screenshot()))
            chromium.close()
    finally:
        server.stop()
        thread.join()
    picture.convert("RGB").quantize(256, dither=Image.Dither.NONE).save(output, optimize=True)


def main() -> None:
    """Record the bag in a temporary directory, and take the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", nargs="?", type=Path, default=Path(__file__).parent / "view.png")
    parser.add_argument("--browser", default=shutil.which("chromium"), help="path of chromium")
    parser.add_argument("--store", type=Path, help="a store of the bag that is there already")
    options = parser.parse_args()
    if options.browser is None:
        parser.error("chromium is not on the PATH; --browser says where it is")
    if options.store is not None:
        with hl.open(options.store) as store:
            look(store, options.browser, options.output)
        return
    with (
        tempfile.TemporaryDirectory() as folder,
        hl.open(Path(folder) / "store", create=True) as store,
    ):
        store.record(BAG)
        look(store, options.browser, options.output)


if __name__ == "__main__":
    main()
