"""Times and integers that numbers of a page are too coarse for; clocks that jump, or are wrong."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode

import numpy as np
import pytest

import hybridlog as hl
from hybridlog_storage.messages import Channel, Schema
from tests.view.conftest import Asking, served, unpacked
from tests.view.test_timeline import picture_of

if TYPE_CHECKING:
    from playwright.sync_api import Page
    from starlette.testclient import TestClient

BOOT = 10**9
START = 1_700_000_000_123_456_789
STEP = 101  # ns; numbers of a page tell 256 ns apart
COUNT = 200
TIMES = [START + n * STEP for n in range(COUNT)]
OFFSETS = [str(time - BOOT) for time in TIMES]
DEFINITION = (
    b"uint64 id\nint64 sid\nfloat64 longitude\nfloat64 latitude\nfloat32 f\nuint64[2] ids\n"
    b"uint8 even\n"
)
NUMBERS: dict[str, Any] = {"recording": "jump", "topic": "/num"}
MATCHES = {**NUMBERS, "where": "even == 1"}


def row(n: int) -> dict[str, Any]:
    return {
        "id": 2**64 - 1 - n,
        "sid": -(2**63) + n,
        "longitude": 13.40495412345678 + n * 1e-14,
        "latitude": 52.520008123456789,
        "f": float(np.float32(0.1 + n / 1000)),
        "ids": [2**64 - 1 - n, 2**53 + 1],
        "even": int(n % 2 == 0),
    }


def packed(n: int) -> bytes:
    *plain, ids, even = row(n).values()
    return struct.pack("<Qqddf2QB", *plain, *ids, even)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    boot = Channel("/boot", "ros1", Schema("own/Boot", "ros1msg", b"uint8 n\n"))
    numbers = Channel("/num", "ros1", Schema("own/Numbers", "ros1msg", DEFINITION))
    with hl.open(tmp_path_factory.mktemp("exact") / "store", create=True) as made:
        for label in ("jump", "other"):
            with made.start(label) as recording:
                recording.write(boot, b"\0", log_time=BOOT)
                for n, time in enumerate(TIMES):
                    recording.write(numbers, packed(n), log_time=time + (label == "other"))
        with made.start("twins") as recording:
            for n in range(12):
                recording.write(numbers, packed(n), log_time=START + n // 3)
        yield made


@pytest.fixture(scope="module")
def client(store: hl.Store, asking: Asking) -> TestClient:
    return asking(store)


def message_at(client: TestClient, at: str) -> dict[str, Any]:
    found = client.get("message", params={**NUMBERS, "at": at}).json()
    return {**found, "id": found["tree"]["items"][0]["text"]}


def test_an_episode_leads_to_its_first_message(client: TestClient) -> None:
    """Every other message matches: each is an episode, until the next message."""
    found = client.get("episodes", params={**MATCHES, "at": 0, "count": COUNT}).json()
    assert (found["before"], found["all"]) == (0, COUNT // 2)
    times = [*zip(OFFSETS[::2], OFFSETS[1::2], strict=True)]
    assert [(at, end, n) for at, end, _, n in found["rows"]] == [(*one, 1) for one in times]
    for n, (at, *_) in zip(range(0, COUNT, 2), found["rows"], strict=True):
        shown = message_at(client, at)
        assert (shown["time"], shown["id"]) == (at, str(row(n)["id"]))
        assert shown["until"] == OFFSETS[n + 1]
        after = {**MATCHES, "at": int(at) + 1, "count": 1}
        later = client.get("episodes", params=after).json()["rows"]
        assert [one[0] for one in later] == OFFSETS[n + 2 : n + 3]


def test_an_episode_leads_to_its_message_among_others_of_its_time(client: TestClient) -> None:
    """Three messages share each time; where the last one does not match, nothing holds."""
    asked = {**MATCHES, "recording": "twins"}
    rows = client.get("episodes", params={**asked, "at": 0}).json()["rows"]
    assert [(at, end, n) for at, end, _, n in rows] == [
        ("0", "1", 2),
        ("1", "1", 1),
        ("2", "3", 2),
        ("3", "3", 1),
    ]
    for n, (at, _, seq, _) in zip((0, 4, 6, 10), rows, strict=True):
        found = client.get("message", params={**asked, "at": at, "seq": seq}).json()
        assert (found["seq"], found["tree"]["items"][0]["text"]) == (seq, str(row(n)["id"]))
        assert found["until"] == (str(n // 3 + 1) if n < 9 else None)
    before = {**asked, "at": 2, "seq": rows[1][2]}  # of the time before
    assert client.get("message", params=before).json()["seq"] == rows[1][2] + 1  # the last one


def test_values_of_a_plot_are_exact(client: TestClient) -> None:
    fields = ["id", "sid", "ids[0]", "ids[1]", "longitude"]
    asked = {**NUMBERS, "field": fields, "begin": 0, "end": int(OFFSETS[-1]) + 1}
    few = client.get("series", params={**asked, "pixels": 1000}).json()
    assert few["times"] == OFFSETS
    lines = {one["field"]: one["least"] for one in few["fields"]}
    assert lines["id"] == lines["ids[0]"] == [str(row(n)["id"]) for n in range(COUNT)]
    assert lines["sid"] == [str(row(n)["sid"]) for n in range(COUNT)]
    assert lines["ids[1]"] == [str(2**53 + 1)] * COUNT
    assert lines["longitude"] == [row(n)["longitude"] for n in range(COUNT)]
    asked = {**asked, "begin": int(OFFSETS[0]), "pixels": 2}
    many = client.get("series", params=asked).json()
    ends = {one["field"]: [*one["least"], *one["greatest"]] for one in many["fields"]}
    half = COUNT // 2
    assert ends["id"] == [str(row(n)["id"]) for n in (half - 1, COUNT - 1, 0, half)]
    assert ends["sid"] == [str(row(n)["sid"]) for n in (0, half, half - 1, COUNT - 1)]


def test_times_of_a_track_are_exact(client: TestClient) -> None:
    _, found = unpacked(client.get("track", params={**NUMBERS, "pixels": 1000}).content)
    times = [int(a) + int(b) for a, b in zip(found["times"], found["rests"], strict=True)]
    assert [str(time) for time in times] == OFFSETS


def sql(client: TestClient, text: str, recording: str = "jump") -> dict[str, Any]:
    answer = client.get("sql", params={"recording": recording, "text": text})
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def test_rows_of_sql_lead_to_their_time(client: TestClient) -> None:
    assert sql(client, "select t, log_time from num order by t")["at"] == OFFSETS
    # A timestamp leads behind all messages of its microsecond, at most to the last one of all.
    late = [str(min(time // 1000 * 1000 + 999, TIMES[-1]) - BOOT) for time in TIMES]
    assert sql(client, "select log_time, recording from num order by t")["at"] == late
    others = "[1000000000 + any_value(t), 9000000000000000000, null]"
    for text in (
        f"select unnest({others})::bigint as t from num",
        "select timestamp '9999-01-01' as log_time",
    ):
        found = sql(client, text)
        assert found["rows"]
        assert {*found["at"]} == {None}


def test_values_of_sql_are_exact_and_of_the_recording_of_the_page(client: TestClient) -> None:
    text = "select id, sid, longitude, f, {{'at': latitude}} as at, recording from num where t = {}"
    for label, at in (("jump", TIMES[7]), ("other", TIMES[7] + 1)):
        want = row(7)
        values = [str(want[name]) for name in ("id", "sid", "longitude")]
        wanted = [*values, "0.107", f"{{at: {want['latitude']}}}", label]
        assert sql(client, text.format(at), label)["rows"] == [wanted]


MS = 10**6
LAST = 2**63 - 1
"""The last time that can be written."""
FAR = 2 * 10**18 + 2**62
SENT = 300
WRONG: Mapping[str, list[int]] = {
    "zero": [n * MS for n in range(SENT)],
    "far": [FAR + n * MS for n in range(SENT)],
    "last": [LAST - SENT + n + 1 for n in range(SENT)],
    "all": [0, *(LAST - (SENT - n) * MS for n in range(1, SENT))],
}
EVERYTHING = {"begin": -LAST, "end": LAST}


@pytest.fixture(scope="module")
def clocks(tmp_path_factory: pytest.TempPathFactory, asking: Asking) -> Iterator[TestClient]:
    channel = Channel("/v", "ros1", Schema("own/V", "ros1msg", b"float64 v\nfloat64[] a\n"))
    with hl.open(tmp_path_factory.mktemp("times") / "store", create=True) as store:
        for label, times in WRONG.items():
            with store.start(label) as recording:
                for n, time in enumerate(times):
                    payload = struct.pack("<dI2d", n, 2, n, -n)
                    recording.write(channel, payload, log_time=time)
        yield asking(store)


@pytest.mark.parametrize("label", WRONG)
def test_pictures_at_the_ends_of_time(clocks: TestClient, label: str) -> None:
    times = WRONG[label]
    start, behind = times[0], times[-1] - times[0] + 1
    asked = {"recording": label, "topic": "/v", "pixels": 100}
    for span in (EVERYTHING, {"begin": -start, "end": min(behind, LAST)}):
        drawn = picture_of(clocks, {**asked, **span})
        assert int(drawn.lanes[0].counts.sum()) == SENT
        rest = {**asked, **span, "pixels": 20}
        (series,) = clocks.get("series", params={**rest, "field": "v"}).json()["fields"]
        assert min(v for v in series["least"] if v is not None) == 0
        assert max(v for v in series["greatest"] if v is not None) == SENT - 1
        for where in ("v > 9", "a[1] < -9"):
            found = clocks.get("matches", params={**rest, "where": where})
            assert sum(found.json()["counts"]) == SENT - 10
        found = clocks.get("ask", params={**span, "recording": label})
        assert found.json()["count"] == SENT


@pytest.mark.parametrize("label", WRONG)
def test_messages_at_the_ends_of_time(clocks: TestClient, label: str) -> None:
    times = WRONG[label]
    asked = {"recording": label, "topic": "/v"}
    at = [time - times[0] for time in times]
    for n in (0, 7, SENT - 3):  # the last time counts as the one before it
        found = clocks.get("message", params={**asked, "at": at[n]}).json()
        assert (found["time"], found["until"]) == (str(at[n]), str(at[n + 1]))
    found = clocks.get("episodes", params={**asked, "where": "v > 5", "at": at[-1]}).json()
    assert (found["rows"], found["all"]) == ([], 1)
    asked = {**asked, "where": "v > 5", "at": at[-1], "direction": "earlier"}
    (episode,) = clocks.get("episodes", params={**asked, "count": 1}).json()["rows"]
    assert (episode[0], episode[3]) == (str(at[6]), SENT - 6)
    if label == "all":
        text = "select t, v from v order by t desc limit 2"
        assert sql(clocks, text, label)["at"] == [str(at[-1]), str(at[-2])]


def asked_on(page: Page, url: str, recording: str, *panels: dict[str, Any]) -> None:
    """Open a recording with panels and the question for matches."""
    ask = {"kind": "predicate", "topic": "/num", "text": MATCHES["where"], "within": ""}
    shown = {"recording": recording, "panels": json.dumps(panels), "ask": json.dumps(ask)}
    page.goto(f"{url}#{urlencode(shown)}")


def click(page: Page, n: int) -> None:
    page.get_by_role("complementary").get_by_role("button", name=f"#{n // 2 + 1} ").first.click()


def is_shown(page: Page, n: int) -> None:
    page.locator("li[aria-current]", has_text=f"#{n // 2 + 1} ").wait_for()
    page.locator(".tree .leaf", has_text=f"id{row(n)['id']}").first.wait_for()


@pytest.mark.peer("browser")
def test_the_page_shows_what_is_clicked(page: Page, store: hl.Store) -> None:
    fields = ["id", "sid", "longitude", "f"]
    panels = [
        {"kind": "message", "topic": "/num", "options": {}},
        {"kind": "plot", "topic": "/num", "options": {"fields": fields}},
    ]

    def check(n: int) -> None:
        is_shown(page, n)
        assert f"at={OFFSETS[n]}" in page.evaluate(
            "import('./state.js').then(s => `at=${s.get('at')}`)"
        )
        for field in fields:
            output = page.locator(f'output[data-field="{field}"]')
            value = row(n)[field]
            assert output.inner_text() == (str(np.float32(value)) if field == "f" else str(value))

    with served(store) as url:
        asked_on(page, url, "jump", *panels)
        for n in (2, 98, 50):
            click(page, n)
            check(n)
        page.locator("body").press("n")
        check(52)
        for n in range(50, 40, -2):
            page.keyboard.press("p")
            check(n)
        page.keyboard.press("End")
        page.locator(".tree .leaf", has_text=f"id{row(COUNT - 1)['id']}").first.wait_for()
        readout = page.get_by_label("Cursor", exact=True).inner_text()
        assert readout.split()[0] == f"+{int(OFFSETS[-1]) // 10**9}.{OFFSETS[-1][-9:]}"
        assert readout.endswith(str(TIMES[-1])[-9:])
