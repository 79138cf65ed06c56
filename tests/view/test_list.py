"""The list of recordings, asked by itself and seen in a browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import hybridlog as hl
from hybridlog_storage.messages import Channel
from tests.view.conftest import Asking

if TYPE_CHECKING:
    from playwright.sync_api import Page
    from starlette.testclient import TestClient


def test_a_row_says_what_the_store_says(client: TestClient, demo_store: hl.Store) -> None:
    answer = client.get("recordings").json()
    (summary,) = demo_store.session.look().summaries
    assert (answer["all"], answer["found"], answer["messages"]) == (1, 1, summary.messages)
    (row,) = answer["rows"]
    assert (row["name"], row["tags"], row["topics"]) == ("robot", {"place": "lab"}, 18)
    assert row["start"] == str(summary.extent[0])
    assert row["duration"] == summary.extent[1] - summary.extent[0]
    assert not row["incomplete"]


@pytest.mark.parametrize(
    ("conditions", "found"),
    [
        ({"name": "obo"}, 1),
        ({"name": "r*t", "tag": "place=lab", "topic": "scan", "begin": "2001-01-01"}, 1),
        ({"name": "[x"}, 0),
        ({"tag": ["place", "place=home"]}, 0),
        ({"type": "sensor_msgs/NavSatFix"}, 0),
        ({"where": "odom: pose.pose.position.x > 1000"}, 0),
        ({"end": "2001-01-01"}, 0),
    ],
)
def test_conditions(client: TestClient, conditions: dict[str, str], found: int) -> None:
    answer = client.get("recordings", params=conditions).json()
    assert (answer["all"], answer["found"], len(answer["rows"])) == (1, found, found)


def test_a_new_recording_is_found_by_its_name(tmp_path: Path, asking: Asking) -> None:
    with hl.open(tmp_path / "store", create=True) as store, hl.open(tmp_path / "store") as other:
        client = asking(other)
        assert client.get("recordings").json()["all"] == 0
        for label in ("first", "second"):
            with store.start(label) as recording:
                recording.write(Channel("/a", "raw", None), b"", log_time=1)
            answer = client.get("recording", params={"recording": label})
            assert answer.json()["messages"] == 1
            named = {"recording": label, "topic": "/a", "at": 0}
            assert client.get("message", params=named).json()["time"] == "0"
        answer = client.get("recording", params={"recording": "<img>"})
        assert (answer.status_code, "<img>" in answer.json()["error"]) == (404, True)


def test_a_recording_says_what_the_store_says(client: TestClient, demo_store: hl.Store) -> None:
    answer = client.get("recording", params={"recording": "robot"}).json()
    (entry,) = demo_store.recordings()
    assert entry.span is not None
    assert (int(answer["start"]), answer["begin"]) == (entry.span[0], "0")
    assert answer["end"] == str(entry.span[1] - entry.span[0] + 1)
    topics = {row["topic"]: row for row in answer["topics"]}
    assert sorted(topics) == demo_store.topics()
    for topic, row in topics.items():
        times = demo_store.topic(topic).to_arrow()["log_time"].cast("int64").to_numpy()
        assert row["messages"] == len(times)
        assert [row["first"], row["last"]] == [str(times[n] - entry.span[0]) for n in (0, -1)]


@pytest.mark.peer("browser")
def test_a_recording_is_found_and_opened(page: Page, demo_url: str) -> None:
    page.goto(demo_url)
    page.wait_for_selector("text=1 recording:")
    page.get_by_label("Topic").fill("nothing_like_that")
    page.wait_for_selector("text=0 of 1 recording:")
    page.get_by_label("Topic").fill("")
    page.get_by_label("With a message").fill("scan: ranges.min <")
    page.keyboard.press("Enter")
    assert "^" in page.get_by_role("alert").inner_text()
    page.get_by_label("With a message").fill("scan: ranges.min < 0.5")
    page.keyboard.press("Enter")
    page.get_by_role("link", name="robot").click()
    page.wait_for_selector("text=18 topics")
    assert "#recording=robot" in page.url
    page.go_back()
    page.wait_for_selector("text=1 recording:")


def test_files_of_the_page_are_kept_by_the_browser(client: TestClient) -> None:
    first = client.get("app.js")
    assert first.headers["cache-control"] == "no-cache"
    assert client.get("app.js", headers={"If-None-Match": first.headers["etag"]}).status_code == 304
