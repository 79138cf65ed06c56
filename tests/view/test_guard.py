"""Strangers: requests that no page of ours makes, on a real port, byte by byte."""

from __future__ import annotations

import http.client
import json
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import quote, urlencode, urlsplit

import pytest

import hybridlog as hl
from hybridlog.view import guard
from hybridlog.view.routes import ask, pictures
from tests.limits import Limit
from tests.view.conftest import served

if TYPE_CHECKING:
    from playwright.sync_api import Page

STATIC = Path(guard.__file__).parent / "static"


class Answer(NamedTuple):
    status: int
    headers: dict[str, str]
    body: bytes


class Door(NamedTuple):
    """Where the server is."""

    port: int
    token: str

    @classmethod
    def of(cls, url: str) -> Door:
        parts = urlsplit(url)
        assert parts.port is not None
        return cls(parts.port, parts.path.strip("/"))

    def ask(
        self,
        path: str,
        headers: dict[str, str] | None = None,
        *,
        method: str = "GET",
        host: str | None = "",
    ) -> Answer:
        """Ask for a path, which is sent as it is."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        try:
            connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
            if host is not None:
                connection.putheader("Host", host or f"127.0.0.1:{self.port}")
            for name, value in (headers or {}).items():
                connection.putheader(name, value)
            connection.endheaders()
            found = connection.getresponse()
            named = {name.lower(): value for name, value in found.getheaders()}
            return Answer(found.status, named, found.read())
        finally:
            connection.close()

    def below(self, path: str, headers: dict[str, str] | None = None, **options: Any) -> Answer:
        return self.ask(f"/{self.token}/{path}", headers, **options)

    def say(self, raw: bytes) -> bytes:
        """All that the server says to some bytes before it closes the connection."""
        with socket.create_connection(("127.0.0.1", self.port), timeout=60) as connection:
            connection.sendall(raw)
            heard = []
            while part := connection.recv(65536):
                heard.append(part)
        return b"".join(heard)


@pytest.fixture(scope="module")
def door(demo_store: hl.Store) -> Iterator[Door]:
    with served(demo_store) as url:
        yield Door.of(url)


def test_the_page_itself_is_let_in(door: Door) -> None:
    answer = door.below("")
    assert answer.status == 200
    assert b"<!doctype html>" in answer.body
    policy = answer.headers["content-security-policy"]
    assert "default-src 'self'" in policy
    assert "unsafe" not in policy
    assert "frame-ancestors 'none'" in policy
    assert "access-control-allow-origin" not in answer.headers
    said = ("x-content-type-options", "referrer-policy", "cache-control")
    assert [answer.headers[name] for name in said] == ["nosniff", "no-referrer", "no-cache"]
    assert door.below("recordings").headers["cache-control"] == "no-store"


def test_without_the_token_nothing_is_told(door: Door) -> None:
    token = door.token
    wrong = [
        "",
        f"{token}x",
        token.swapcase(),
        f"%00{token}",
        "é",
        "%FF",
        "..",
        f"x/{token}",
        f"x/../{token}",
    ]
    said = set()
    for first in wrong:
        for rest in ("", "recordings", "app.js"):
            path = quote(f"/{first}/{rest}", safe="/%.")
            answer = door.ask(path)
            assert answer.status == 404, path
            said.add(answer.body)
    assert len(said) == 1  # so that nothing can be learned from the differences
    assert token.encode() not in said.pop()
    assert door.ask("*").status in {400, 404}
    assert door.ask("/", {"Cookie": f"token={token}", "Authorization": token}).status == 404
    assert door.ask(f"/?{token}").status == 404
    assert door.ask(f"/recordings?token={token}").status == 404


@pytest.mark.parametrize(
    "host",
    [
        "evil.example",
        "127.0.0.1",
        "127.0.0.1:1",
        "127.0.0.1.evil.example:{port}",
        "0.0.0.0:{port}",
        "user@127.0.0.1:{port}",
        "127.0.0.1:{port}, evil.example",
        " ",
    ],
)
def test_other_hosts_are_refused(door: Door, host: str) -> None:
    # A page of another site whose name was made to mean this machine.
    assert door.below("recordings", host=host.format(port=door.port)).status in {400, 421}


def test_one_host_and_origin_are_named(door: Door) -> None:
    line = f"GET /{door.token}/recordings HTTP/1.{{}}\r\n"
    host = f"Host: 127.0.0.1:{door.port}\r\n"
    end = "Connection: close\r\n\r\n"
    for minor, hosts in ((1, ""), (0, ""), (1, host + host), (1, host + "Host: evil.example\r\n")):
        heard = door.say((line.format(minor) + hosts + end).encode())
        assert heard.split(b" ")[1] in {b"400", b"421"}, (minor, hosts)
    assert door.say((line.format(1) + host + end).encode()).split(b" ")[1] == b"200"
    own = f"Origin: http://127.0.0.1:{door.port}\r\n"
    for origins in (own + "Origin: https://evil.example\r\n", own + own):
        heard = door.say((line.format(1) + host + origins + end).encode())
        assert heard.split(b" ")[1] == b"400"
    # With an absolute address, the Host header still counts.
    for named, code in (("127.0.0.1", b"404"), ("evil.example", b"404")):
        absolute = f"GET http://{named}:{door.port}/{door.token}/ HTTP/1.1\r\n{host}{end}"
        assert door.say(absolute.encode()).split(b" ")[1] == code


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "https://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:1"},
        {"Origin": "https://127.0.0.1:{port}"},
        {"Origin": "http://127.0.0.1:{port}.evil.example"},
        {"Origin": ""},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site", "Sec-Fetch-Mode": "no-cors"},
    ],
)
def test_other_origins_are_refused(door: Door, headers: dict[str, str]) -> None:
    sent = {name: value.format(port=door.port) for name, value in headers.items()}
    for path in ("recordings", "app.js", ""):
        answer = door.below(path, sent)
        assert answer.status == 403
        assert "access-control-allow-origin" not in answer.headers
    own = {"Origin": f"http://127.0.0.1:{door.port}", "Sec-Fetch-Site": "same-origin"}
    assert door.below("recordings", own).status == 200


@pytest.mark.parametrize(
    "method",
    ["POST", "DELETE", "OPTIONS", "CONNECT", "get", "X" * 99],
)
def test_only_get_is_answered(door: Door, method: str) -> None:
    for path in ("recordings", "", "app.js"):
        answer = door.below(path, method=method)
        assert (answer.status, b"never changes the store" in answer.body) == (405, True)
        assert door.below(path, {"Content-Length": "1000000"}, method=method).status == 405
    assert door.ask("/x/recordings", method=method).status == 404
    asked = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13"}
    answer = door.below("recordings", {**asked, "Sec-WebSocket-Key": "x" * 24})
    assert (answer.status, "upgrade" in answer.headers) == (200, False)  # as without it
    head = door.below("recordings", method="HEAD")
    assert (head.status, head.body) == (200, b"")


UP = ("..", "%2e%2e", ".%2E", "%252e%252e", "..%00", "%c0%ae%c0%ae")
SLASH = ("/", "%2f", "\\", "//")


def test_paths_do_not_leave_the_page(door: Door) -> None:
    """Only files below `static/` come back, whatever is before them."""
    served_files = {path.read_bytes() for path in STATIC.rglob("*") if path.is_file()}
    tried = [
        *(up + slash + "guard.py" for up in UP for slash in SLASH),
        *(f"panels{slash}{up}{slash}{up}{slash}guard.py" for up in UP for slash in SLASH),
        *(f"{up}{slash}" * 12 + "etc/passwd" for up in UP for slash in SLASH),
        *("/etc/passwd", "//etc/passwd", "%2fetc%2fpasswd", "file:///etc/passwd", "~root"),
        *("vendor", "panels/", "app.js/..", "app.js%00.html", "%00", "recordings/.."),
        *("x" * 5000, "/".join("x" * 3000), "static/app.js"),
    ]
    for path in tried:
        answer = door.below(path)
        assert answer.status in {200, 307, 400, 404}, path
        assert b"root:" not in answer.body
        if answer.status == 200 and answer.body[:1] != b"{":
            assert answer.body in served_files, path
        if answer.status == 307:
            assert answer.headers["location"].startswith(
                f"http://127.0.0.1:{door.port}/{door.token}/"
            )


ABSURD = (
    "",
    "-1",
    "1e9",
    "-9223372036854775809",
    "9" * 400,
    "NaN",
    "١٢",
    "💥" * 300,
    "../../../etc/passwd",
    "[" * 3000,
    "x" * 8000,
    "a" + " and a" * 1200,
    "'; drop table x; --",
    "\ud7ff\ufffe",
)
USUAL = {
    "recording": "robot",
    "topic": "/base/scan",
    "at": "5000000000",
    "begin": "0",
    "end": "9000000000",
    "pixels": "100",
    "field": "ranges.min",
    "text": "ranges.min < 0.5",
    "place": "3",
    "around": "/base/scan",
}


def asked_by_routes() -> list[tuple[str, list[str]]]:
    """Path of each route with its parameters."""
    found = []
    for one in (*ask.routes, *pictures.routes):
        _, *names = signature(one.endpoint).parameters
        found.append((one.path, names))
    assert {"/recordings", "/points", "/track"} <= {path for path, _ in found}
    return found


def test_absurd_parameters_break_nothing(door: Door, capfd: pytest.CaptureFixture[str]) -> None:
    """Each parameter of each route with two absurd values, where the others are usual."""
    turn = 0
    for path, names in asked_by_routes():
        for name in names:
            for value in [ABSURD[(turn + 5 * n) % len(ABSURD)] for n in range(2)]:
                check(door, path, list({**USUAL, name: value}.items()))
            turn += 1
        check(door, path, [])
        check(door, path, [(name, "1") for name in names] * 200)
    # What fails is told there.
    assert capfd.readouterr().err == ""


def check(door: Door, path: str, parameters: list[tuple[str, str]]) -> None:
    """The answer is one, or says what is wrong with the question; it is never a failure."""
    answer = door.below(f"{path[1:]}?{urlencode(parameters)}")
    context = path, parameters[:20], answer.status, answer.body[:200]
    assert answer.status in {200, 204, 400, 404}, context
    if answer.status in {400, 404}:
        assert json.loads(answer.body)["error"], context
        assert b"Traceback" not in answer.body, context


def test_requests_have_a_bound(door: Door) -> None:
    """64 kB of a head are refused when they come, without a token and with it."""
    for start in (f"GET /{'x' * (1 << 20)}", f"GET /{door.token}/?{'x' * (1 << 20)}"):
        assert _refused(door, start.encode())
    many = "".join(f"X-{n}: {'y' * 100}\r\n" for n in range(5000))
    assert _refused(door, f"GET /{door.token}/ HTTP/1.1\r\n{many}".encode())
    for nonsense in (b"\x16\x03\x01\x02\x00\x01\r\n\r\n", b"GET\r\n\r\n", b"\xff\r\n\r\n"):
        assert _refused(door, nonsense)
    assert door.below("").status == 200


def _refused(door: Door, raw: bytes) -> bool:
    try:
        heard = door.say(raw)
    except (ConnectionResetError, BrokenPipeError):
        return True  # it was closed before all was sent
    return heard.startswith(b"HTTP/1.1 400 ")


def test_connections_that_only_wait_are_closed(demo_store: hl.Store, limit: Limit) -> None:
    """Those without a request, with part of one, and with an endless body after the answer."""
    limit(connection_patience_s=0.5)
    with served(demo_store) as url:
        door = Door.of(url)
        path, host = f"/{door.token}/", f"Host: 127.0.0.1:{door.port}\r\n"
        begun = [
            "",
            "GET /",
            f"GET {path} HTTP/1.1\r\n{host}X: ",
            f"POST {path} HTTP/1.1\r\n{host}Content-Length: 100000\r\n\r\n",
            f"GET {path}recordings HTTP/1.1\r\n{host}\r\nGET {path}",
        ]
        waiting = []
        for text in begun * 60:
            one = socket.create_connection(("127.0.0.1", door.port), timeout=60)
            one.sendall(text.encode())
            waiting.append(one)
        # More than are served at once; as they go, the page is served again.
        statuses = set()
        for one in waiting:
            assert _drip(one)
            one.close()
        for _ in range(100):
            statuses.add(door.below("").status)
            if 200 in statuses:
                break
            time.sleep(0.05)
        assert 200 in statuses
        assert statuses <= {200, 503}


@pytest.mark.parametrize("shown", ["nothing", "refused"])
def test_strangers_do_not_keep_the_page_out(demo_store: hl.Store, shown: str) -> None:
    """More connections without the token than are served at once, held open."""
    with served(demo_store) as url, ExitStack() as opened:
        door = Door.of(url)
        path, host = f"/{door.token}/", f"Host: 127.0.0.1:{door.port}\r\n"
        said = {
            "nothing": "",
            "refused": f"GET /no-token/ HTTP/1.1\r\n{host}\r\n",
        }[shown]
        kept = http.client.HTTPConnection("127.0.0.1", door.port, timeout=60)
        for n in range(300):
            if n % 50 == 0:  # a connection of the page, which is older than most strangers
                kept.request("GET", f"{path}recordings")
                answer = kept.getresponse()
                assert (answer.status, bool(answer.read())) == (200, True)
            stranger = socket.create_connection(("127.0.0.1", door.port), timeout=60)
            opened.enter_context(stranger).sendall(said.encode())
        assert {door.below("recordings").status for _ in range(20)} == {200}
        kept.request("GET", f"{path}recordings")
        assert kept.getresponse().status == 200
        kept.close()


def _drip(connection: socket.socket) -> bool:
    """True if the server closes a connection on which a byte comes now and then."""
    connection.settimeout(0.1)
    for _ in range(600):
        try:
            connection.sendall(b"x")
            while connection.recv(65536):
                pass
        except TimeoutError:
            continue
        except OSError:
            return True
        return True
    return False


@pytest.mark.peer("browser")
def test_a_hostile_address_shows_a_page_that_works(page: Page, demo_url: str) -> None:
    """Thousands of panels, other kinds of values, and markup in the part behind `#`."""
    attack = "<img src=x onerror=document.title=1>"
    panels: list[Any] = [
        {"kind": attack, "topic": attack},
        {"kind": "points", "topic": attack, "options": {"colour": {"a": [attack]}}},
        {"kind": "map", "topic": "/base/scan", "options": []},
        {"kind": "__proto__", "topic": "constructor"},
        None,
        7,
        *({"kind": "points", "topic": f"/t{n}"} for n in range(5000)),
    ]
    state = {"recording": "robot", "panels": json.dumps(panels), "at": "1e999", "begin": "NaN"}
    page.goto(f"{demo_url}#{urlencode(state)}")
    page.wait_for_selector("article")
    assert page.locator("article").count() <= 24
    assert page.locator("img[src=x]").count() == 0
    for text in (f"recording={quote(attack)}", "recording=robot&panels=[[[[", "&&&=%", "panels={}"):
        page.goto(demo_url)
        page.goto(f"{demo_url}#{text}")
        page.wait_for_selector("#main > *")
    assert "hybridlog" in page.title()
    assert page.locator("img[src=x]").count() == 0
