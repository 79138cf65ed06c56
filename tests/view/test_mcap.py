"""Selections as MCAP: read over HTTP by other people's readers."""

from __future__ import annotations

import base64
import io
from copy import copy
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from mcap.reader import NonSeekingReader
from starlette.testclient import TestClient

import hybridlog as hl
from hybridlog.formats.slices import SliceFiles, write_mcap
from hybridlog.view.guard import Admission
from hybridlog.view.server import make_app
from tests.independent import Seen, read_bag, read_mcap
from tests.limits import Limit
from tests.view.conftest import PORT, TOKEN, served
from tests.waiting import at_once

if TYPE_CHECKING:
    from playwright.sync_api import Page

FOXGLOVE = "https://app.foxglove.dev"
S = 10**9


@pytest.fixture(scope="module")
def seen(demo_store: hl.Store) -> list[Seen]:
    """The bag as the `rosbags` package reads it."""
    return read_bag(demo_store.directory.path.parent / "robot.bag")


@pytest.fixture(scope="module")
def app(demo_store: hl.Store) -> TestClient:
    """The view with MCAP, without a server."""
    guarded = make_app(demo_store, Admission(token=TOKEN, port=PORT, origins=[FOXGLOVE]))
    return TestClient(guarded, base_url=f"http://127.0.0.1:{PORT}/{TOKEN}/mcap/")


def test_a_slice_is_the_one_of_the_command_line(
    app: TestClient, demo_store: hl.Store, tmp_path: Path
) -> None:
    wanted = {"recording": "robot", "topic": "scan", "begin": "+1s", "end": "+2s"}
    got = app.get("slice.mcap", params={**wanted, "where": "ranges.min > 0"})
    query = demo_store.topic("scan").between("+1s", "+2s").where("ranges.min > 0")
    write_mcap(query, tmp_path / "own.mcap")
    assert got.content == (tmp_path / "own.mcap").read_bytes()
    # Typed by hand, the plus is a space.
    typed = app.get("slice.mcap?recording=robot&topic=scan&begin=+1s&end=+2s")
    assert typed.content == app.get("slice.mcap", params=wanted).content


def test_the_bytes_are_the_same_when_the_file_had_to_go(app: TestClient, limit: Limit) -> None:
    limit(slices_bytes=0)
    url = "slice.mcap?recording=robot&topic=/odom"
    first, other = app.get(url), app.get("slice.mcap?recording=robot&topic=/tf")
    again = app.get(url)
    assert again.content == first.content != other.content
    assert again.headers["etag"] == first.headers["etag"] != other.headers["etag"]
    assert again.headers["last-modified"] != "", "it is a file"


def test_a_data_loader_gets_what_the_manifest_says(
    app: TestClient, demo_store: hl.Store, seen: list[Seen]
) -> None:
    wanted = {"recording": "robot", "topic": ["/base/scan", "/tf*"], "begin": "+2s", "end": "+4s"}
    got = app.get("manifest", params=wanted).json()
    assert got["name"] == "robot"
    (source,) = got["sources"]
    assert set(source) == {"url", "id", "topics", "schemas", "startTime", "endTime"}
    data = app.get(source["url"])
    assert data.status_code == 200
    reader = NonSeekingReader(io.BytesIO(data.content))
    messages = list(reader.iter_messages())
    schemas = {row["id"]: row for row in source["schemas"]}
    assert all(0 < number < 1 << 16 for number in schemas)
    topics = {
        (row["name"], row["messageEncoding"], *described(schemas[row["schemaId"]]))
        for row in source["topics"]
    }
    found = {
        (channel.topic, channel.message_encoding, schema.name, schema.encoding, schema.data)
        for schema, channel, _ in messages
        if schema is not None
    }
    assert found == topics
    assert {topic for topic, *_ in found} == {"/base/scan", "/tf", "/tf_static"}
    start, end = (hl_time(source[key]) for key in ("startTime", "endTime"))
    assert all(start <= message.log_time <= end for *_, message in messages)
    begin = seen[0].log_time + 2 * S
    scans = [m for m in seen if m.topic == "/base/scan" and begin <= m.log_time < begin + 2 * S]
    read = [Seen(c.topic, m.log_time, m.data) for _, c, m in messages]
    assert [m for m in read if m.topic == "/base/scan"] == scans
    again = app.get("manifest", params=wanted).json()
    assert again == got, "a loader caches by the id"
    other = app.get("manifest", params={**wanted, "end": "+5s"}).json()
    assert other["sources"][0]["id"] != source["id"]


def described(row: dict[str, Any]) -> tuple[str, str, bytes]:
    return row["name"], row["encoding"], base64.b64decode(row["data"], validate=True)


def hl_time(text: str) -> int:
    from hybridlog.query.times import parse_time

    return parse_time(text, start=None, end=None)


@pytest.mark.parametrize(
    ("parameters", "code"),
    [
        ({}, 400),
        ({"recording": "none"}, 404),
        ({"recording": "../../etc"}, 404),
        ({"recording": "robot", "topic": "/none"}, 404),
        ({"recording": "robot", "topic": ["x"] * 1000}, 400),
        ({"recording": "robot", "begin": "+1h"}, 400),
        ({"recording": "robot", "begin": "x" * 1000}, 400),
        ({"recording": "robot", "topic": "/odom", "where": "none > 1"}, 400),
        ({"recording": "robot", "topic": "/odom", "where": "("}, 400),
    ],
)
@pytest.mark.parametrize("path", ["slice.mcap", "manifest", "data"])
def test_wrong_questions(path: str, parameters: dict[str, Any], code: int, app: TestClient) -> None:
    got = app.get(path, params=parameters)
    assert got.status_code == code
    assert got.json()["error"]


def test_only_with_the_option_and_only_these_routes(client: TestClient, app: TestClient) -> None:
    from_foxglove = {"Origin": FOXGLOVE, "Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "cors"}
    url = "slice.mcap?recording=robot&topic=/map"
    assert client.get(f"mcap/{url}").status_code == 404
    assert client.get(f"mcap/{url}", headers=from_foxglove).status_code == 403
    got = app.get(url, headers={**from_foxglove, "Range": "bytes=0-7"})
    assert got.status_code == 206
    assert got.headers["access-control-allow-origin"] == FOXGLOVE
    assert "Content-Range" in got.headers["access-control-expose-headers"]
    assert got.headers["vary"] == "Origin"
    asked = {**from_foxglove, "Access-Control-Request-Method": "GET"}
    may = app.options(url, headers={**asked, "Access-Control-Request-Headers": "range"})
    assert may.status_code == 204
    assert may.headers["access-control-allow-origin"] == FOXGLOVE
    assert "Range" in may.headers["access-control-allow-headers"]
    for headers in (from_foxglove, asked):
        assert app.get("../recordings", headers=headers).status_code == 403
    for origin in ("https://evil.example", "null", f"{FOXGLOVE}.evil.example"):
        for refused in (
            app.get(url, headers={"Origin": origin}),
            app.options(url, headers={**asked, "Origin": origin}),
        ):
            assert refused.status_code == 403
            assert "access-control-allow-origin" not in refused.headers
    assert app.options(url).status_code == 405
    assert app.post(url, headers=from_foxglove).status_code == 405
    stranger = TestClient(app.app, base_url=f"http://127.0.0.1:{PORT}/other/mcap/")
    assert stranger.get(url).status_code == 404
    assert stranger.options(url, headers=asked).status_code == 404


@pytest.mark.peer("browser")
def test_a_page_of_foxglove_reads_ranges(demo_store: hl.Store, page: Page) -> None:
    """A browser lets that page read them, and another page not."""
    read = """async url => {
        const got = await fetch(url, {headers: {Range: 'bytes=0-7'}})
        return [got.status, got.headers.get('content-range'), (await got.arrayBuffer()).byteLength]
    }"""
    page.context.grant_permissions(["local-network-access"])
    for site in (FOXGLOVE, "https://evil.example"):
        page.route(f"{site}/**", lambda route: route.fulfill(body="<p>", content_type="text/html"))
    with served(demo_store, FOXGLOVE) as url:
        file = f"{url}mcap/slice.mcap?recording=robot&topic=/map"
        page.goto(FOXGLOVE)
        status, content_range, length = page.evaluate(read, file)
        assert (status, length) == (206, 8)
        assert content_range.startswith("bytes 0-7/")


def test_a_slice_is_written_once(demo_store: hl.Store) -> None:
    query, files = demo_store.query(["/odom"]), SliceFiles()
    found: list[tuple[int, str]] = []

    def get() -> None:
        path, digest = files.get(copy(query))
        found.append((path.stat().st_ino, digest))

    at_once(*[get] * 4)
    assert len({*found}) == 1
    assert len(read_mcap(files.get(query)[0])) == query.count()
