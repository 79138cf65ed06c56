"""Questions over HTTP: predicates, SQL, files."""

from __future__ import annotations

import asyncio
import shlex
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode

import pytest
from click.testing import CliRunner

import hybridlog as hl
from hybridlog.cli.commands import fetch
from hybridlog.view.routes.ask import SQL_ROWS
from hybridlog_storage.messages import Channel
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.independent import read_mcap, write_mcap
from tests.limits import Limit

from .conftest import PORT, TOKEN, printed_by

if TYPE_CHECKING:
    from httpx2 import Response
    from playwright.sync_api import Page
    from starlette.testclient import TestClient

NEAR = {"recording": "robot", "topic": "/base/scan", "where": "ranges.min < 0.8"}
BOTH = {**NEAR, "where": "ranges.min < 0.8 and /odom: twist.twist.linear.x > 0.3", "within": "50ms"}
ENDLESS = "select sum(a.range * b.range) from range(10000000) a, range(1000000) b"
S = 10**9


def times(query: hl.Query) -> list[int]:
    return [message.log_time_ns for message in query]


def near(store: hl.Store) -> hl.Query:
    return store.topic("/base/scan").where(NEAR["where"])


def sql(client: TestClient, text: str) -> Response:
    return client.get("sql", params={"recording": "robot", "text": text})


def test_a_predicate_is_counted(client: TestClient, demo_store: hl.Store) -> None:
    answer = client.get("ask", params=NEAR).json()
    want = near(demo_store).count()
    assert want > 20
    assert (answer["count"], answer["lost"], answer["remarks"]) == (want, None, [])
    assert printed_by(answer["python"]).split()[0] == str(want)
    both = client.get("ask", params=BOTH).json()
    want = demo_store.topic("scan").where(BOTH["where"], within="50ms").count()
    assert both["count"] == want > 0
    assert printed_by(both["python"]).split()[0] == str(want)


REFUSED: list[tuple[str, dict[str, Any], str]] = [
    (
        "ask",
        {"where": "ranges.min <"},
        "expected a value here\n  ranges.min <\n              ^",
    ),
    ("ask", {"where": "ranges.minn < 1"}, "ranges.min"),
    ("ask", {"where": "(" * 60 + "range_max > 1" + ")" * 60}, "nested deeper than 50"),
    ("ask", {"where": 'header.frame_id ~ "((a{99}){99}){99}"'}, "pattern"),
    ("ask", {"where": "/odom: twist.twist.linear.x > 1"}, "0.1s"),
    ("ask", {"topic": "scan"}, "no topic 'scan'"),
    ("ask", {"topic": "/<img>"}, "no topic"),
    ("matches", {"begin": 0, "end": 9, "pixels": 10**6}, "pixels"),
    ("matches", {"begin": 9, "end": 9, "pixels": 10}, "greater"),
    ("episodes", {"at": 0, "count": 201}, "count"),
    ("sql", {"text": "select 1; drop table x"}, "no view"),
    ("sql", {"text": "select * from read_text('/etc/passwd')"}, "files"),
    ("ask", {"begin": 100 * S, "end": 101 * S}, "Nothing was recorded"),
    ("ask", {"topic": ["/odom"] * 201}, "200"),
    ("timeline", {"begin": "1000"}, "greater"),
    ("timeline", {"end": 1 << 63}, "`int` <= 9"),
    ("timeline", {"pixels": "8193"}, "8192"),
    ("timeline", {"topic": ["/odom"] * 60, "pixels": 4000}, "pixels"),
    ("recordings", {"order": "colour"}, "order"),
    ("recordings", {"count": "٣"}, "`int`"),
    ("recordings", {"tag": ["a"] * 17}, "16"),
    ("recordings", {"begin": "soon"}, "soon"),
    ("message", {"at": None}, "missing"),
    ("message", {"path": "1..2"}, "path"),
    ("message", {"path": "1.99"}, "no such part"),
    ("series", {"field": "header.frame_id", "end": 9 * S}, "no number"),
    ("rows", {"before": 501}, "500"),
    ("points", {"limit": 500_001}, "500000"),
    ("track", {}, "no latitude"),
]


@pytest.mark.parametrize(("path", "changes", "problem"), REFUSED)
def test_what_is_refused(
    client: TestClient, path: str, changes: dict[str, Any], problem: str
) -> None:
    usual = {**NEAR, "at": 5 * S, "begin": 0, "end": 1000, "pixels": 10, "field": "range_max"}
    asked = {**(usual if path != "recordings" else {}), **changes}
    answer = client.get(path, params={k: v for k, v in asked.items() if v is not None})
    assert answer.status_code in {400, 404}
    assert problem in answer.json()["error"]


def test_sql_is_bounded(client: TestClient, limit: Limit) -> None:
    answer = sql(client, "select range from range(100000)").json()
    assert (len(answer["rows"]), answer["more"], answer["at"]) == (SQL_ROWS, True, [])
    answer = sql(client, "select count(*) as n, min(topic) as first from topics").json()
    assert answer["columns"] == [["n", True], ["first", False]]
    assert answer["rows"][0][0] in printed_by(answer["python"])
    wide = "select " + ", ".join(f"{n} as c{n}" for n in range(300))
    answer = sql(client, wide).json()
    assert (len(answer["columns"]), answer["columns_left_out"]) == (200, 100)
    limit(sql_seconds=0.2)
    answer = sql(client, ENDLESS)
    assert "stopped after 0.2 s" in answer.json()["error"]


def asked_for(
    app: Any, path: str, params: dict[str, Any], *, leaves_after: float | threading.Event
) -> list[dict[str, Any]]:
    """What is said to a client that leaves: after seconds, or an event."""
    with ThreadPoolExecutor(1) as pool:  # playwright has a loop in this thread
        return pool.submit(asyncio.run, _asked_for(app, path, params, leaves_after)).result()


async def _asked_for(
    app: Any, path: str, params: dict[str, Any], leaves_after: float | threading.Event
) -> list[dict[str, Any]]:
    scope = {
        "type": "http",
        "method": "GET",
        "path": f"/{TOKEN}/{path}",
        "query_string": urlencode(params, doseq=True).encode(),
        "headers": [(b"host", f"127.0.0.1:{PORT}".encode())],
    }
    said: list[dict[str, Any]] = []

    async def receive() -> dict[str, Any]:
        if isinstance(leaves_after, float):
            await asyncio.sleep(leaves_after)
        else:
            while not leaves_after.is_set():
                await asyncio.sleep(0.01)
        return {"type": "http.disconnect"}

    async def send(message: Any) -> None:
        said.append(message)

    await asyncio.wait_for(app(scope, receive, send), 30)
    return said


DAMAGED = "x-1"


@pytest.fixture(scope="module")
def odd(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    """A store of odd names, one of which lost some."""
    place = tmp_path_factory.mktemp("odd")
    large = Channel("/large", "raw", None)
    others = [Channel(name, "json", None) for name in ("/a b", "*")]
    said = []
    for n in range(60):
        said.append((large, n * S, bytes(500_000)))
        said += [(one, n * S + 1, b'{"n": %d, "odd.name": 1}' % n, n * S) for one in others]
    write_mcap(place / "odd.mcap", said)
    with hl.open(place / "store", create=True) as store:
        for name in ("x [1]", "x [1]", "x-1"):
            settings = SegmentSettings(segment_size=1)  # a chunk each
            store.record(place / "odd.mcap", name=name, again=True, settings=settings)
    places.segment(place / "store", DAMAGED, 1).unlink()
    with hl.open(place / "store") as store:
        yield store


@pytest.mark.parametrize(
    "asked",
    [
        {"topic": "/a b", "where": "n >= 58"},
        {"topic": ["*", "/a b"], "begin": 58 * S, "end": 60 * S},
    ],
)
def test_odd_names(
    odd: hl.Store,
    asking: Callable[[hl.Store], TestClient],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    asked: dict[str, Any],
) -> None:
    monkeypatch.chdir(tmp_path)
    for label in ("x [1]", "x [1]-2"):
        check_command(asking(odd), {"recording": label, **asked})


def check_command(client: TestClient, params: dict[str, Any]) -> None:
    """The command line writes what is counted into the current directory; so does Python count."""
    told = client.get("ask", params=params).json()
    words = shlex.split(told["command"])
    assert words[:2] == ["hybridlog", "fetch"]
    done = CliRunner().invoke(fetch.fetch_command, words[2:], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    latched = {"/map", "/tf_static"}  # in front of a slice
    written = [m for m in read_mcap(Path(words[-1])) if m.topic not in latched]
    assert len(written) == told["count"] > 0
    assert printed_by(told["python"]).split()[0] == str(told["count"])


def test_losses_are_told(odd: hl.Store, asking: Callable[[hl.Store], TestClient]) -> None:
    client = asking(odd)
    asked = {"recording": DAMAGED, "topic": "/large", "where": "_meta.seq >= 0"}
    query = odd.topic("/large").in_recording(DAMAGED)
    lost = query.completeness()
    assert 0 < lost.messages < 60
    want = lost.describe(query.count())
    assert "lost in this range" in want
    assert client.get("ask", params=asked).json()["lost"] == want
    answer = client.get("sql", params={**asked, "text": "select count(*) from large"}).json()
    assert any(f"{lost.messages} messages lost in" in line for line in answer["remarks"])


EXPORTS: list[dict[str, Any]] = [
    {"begin": 5 * S, "end": 6 * S + 1},
    {"topic": ["/odom", "/base/scan"], "begin": 5 * S, "end": 6 * S},
    {"topic": "/base/scan", "where": NEAR["where"]},
    {"topic": "/base/scan", "where": BOTH["where"], "within": "50ms", "begin": 0, "end": 18 * S},
]


@pytest.mark.parametrize("asked", EXPORTS)
def test_the_command_line_writes_what_is_counted(
    client: TestClient,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    asked: dict[str, Any],
) -> None:
    params = {"recording": "robot", **asked}
    monkeypatch.chdir(tmp_path)
    check_command(client, params)
    (made,) = tmp_path.iterdir()
    assert made.name.startswith("robot_")


@pytest.mark.peer("browser")
def test_a_question_is_asked_and_its_matches_are_found(
    page: Page, demo_url: str, demo_store: hl.Store, start: int, client: TestClient
) -> None:
    asked_for = demo_store.topic("scan").where("ranges.min < 0.8")
    want = [time - start for time in times(asked_for)]
    episodes = [one.begin_ns - start for one in asked_for.intervals()]
    assert 1 < len(episodes) < len(want)
    page.goto(f"{demo_url}#recording=robot")
    page.get_by_label("Topic of the question").select_option("/base/scan")
    page.locator("body").press("/")
    page.keyboard.type("ranges.min <")
    page.keyboard.press("Enter")
    assert (
        page.locator(".ask .body .problem").inner_text().endswith("ranges.min <\n              ^")
    )
    page.keyboard.type(" 0.8")
    page.keyboard.press("Enter")
    page.get_by_text(f"{len(want)} matches").wait_for()
    page.keyboard.press("Escape")
    page.keyboard.press("n")
    page.locator("li[aria-current]", has_text="#1 ").wait_for()
    page.keyboard.press("n")
    page.locator("li[aria-current]", has_text="#2 ").wait_for()
    page.keyboard.press("p")
    page.locator("li[aria-current]", has_text="#1 ").wait_for()
    shown = page.evaluate(
        "import(`${document.baseURI.split('#')[0]}overlays.js`)"
        ".then((o) => o.all().filter(({ lane }) => !lane))"
    )
    assert sum(count for _, count in shown[0]["ticks"]) == len(want)
    assert shown[0]["ticks"][0][0] == want[0] == shown[0]["bands"][0][0]
    page.get_by_role("complementary").get_by_role("button", name="#2 ").first.click()
    page.wait_for_url(lambda url: f"&at={episodes[1]}&" in url)
    page.get_by_role("button", name="Export").click()
    page.get_by_label("Part to export").select_option("matches")
    page.get_by_text(f"{len(want)} messages").wait_for()
    asked = {**NEAR, "recording": "robot"}
    told = client.get("ask", params=asked).json()
    assert page.get_by_label("Command line").inner_text() == told["command"]
    page.get_by_label("Language").select_option("sql")
    question = page.get_by_label("Question", exact=True)
    question.fill("select log_time, '<b>x</b>' as bold from scan order by t desc limit 2")
    question.press("Enter")
    page.locator("td", has_text="<b>x</b>").nth(1).wait_for()
    page.locator("td button").first.click()
    last = next(iter(demo_store.topic("scan").reverse()))
    at = last.log_time_ns - start
    page.wait_for_url(lambda url: f"&at={at}&" in url)
    page.go_back()
    page.get_by_text(f"{len(want)} matches").wait_for()
    assert question.input_value() == "ranges.min < 0.8"
