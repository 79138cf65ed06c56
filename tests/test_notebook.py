"""What notebooks show, and what they complete."""

from __future__ import annotations

import json
from collections.abc import Iterator
from html.parser import HTMLParser

import pytest

import hybridlog as hl
from hybridlog.drawing.notebook import message_html, recordings_html
from hybridlog.message import Message
from hybridlog_storage.errors import TopicError
from hybridlog_storage.messages import Channel
from tests.test_snapshot import summary

HOSTILE = "<script>alert('x')</script>&\"\x1b[31m"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    """Messages of hostile names and values, and pictures."""
    path = tmp_path_factory.mktemp("notebook")
    odd = {HOSTILE: HOSTILE, "nested": {"list": list(range(100))}, "long": "x" * 1000}
    many = {f"f{n}": n for n in range(50)}
    with hl.open(path / "store", create=True) as opened:
        with opened.start(HOSTILE, tags={HOSTILE: HOSTILE}) as recording:
            for channel, payload in (
                (Channel(f"/{HOSTILE}", "json", None), json.dumps(odd).encode()),
                (Channel("/many", "json", None), json.dumps(many).encode()),
                *((Channel(name, "json", None), b"{}") for name in ("/a", "/b", "/c", "/d")),
            ):
                recording.write(channel, payload, log_time=10**18)
        yield opened


class Parsed(HTMLParser):
    """The tags of HTML, and its text."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.open: list[str] = []
        self.text = ""
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


PLAIN = {"p", "b", "table", "tr", "td"}


def only(store: hl.Store, topic: str) -> Message:
    return next(iter(store.topic(topic)))


def test_names_and_values_are_text(store: hl.Store) -> None:
    hostile = only(store, f"/{HOSTILE}")
    for thing in (store, store.recordings(), hostile):
        parsed = Parsed(thing._repr_html_())
        assert set(parsed.tags) <= PLAIN
        assert "alert('x')" in parsed.text
    parsed = Parsed(hostile._repr_html_())
    assert HOSTILE in parsed.text
    assert "nested.list" in parsed.text
    assert "x" * 200 not in parsed.text


def test_output_is_bounded() -> None:
    made = [summary(n, (n, n), ["/a"], tags={"t": "v" * 10_000})[0] for n in range(1000)]
    html = recordings_html("many", made)
    assert len(html) < 20_000
    assert "1000 recordings" in html
    assert ">r999<" in html
    assert ">r979<" not in html
    deep = {"deep": ["y" * 1000] * 1000}
    html = message_html("m" * 10_000, {f"f{n}": deep for n in range(1000)})
    assert len(html) < 20_000
    assert html.count("<tr>") == 20


def test_every_answer_is_a_table_and_an_error_has_no_traceback(store: hl.Store) -> None:
    many = store.topic("/many")
    answers = (
        many.stats("f1"),
        many.check(),
        store.check(),
        many.intervals(),
        store.align("/many", "/a"),
        many.resample("1s"),
        store.sync(["/many", "/a"], clock="log"),
    )
    for thing in (*answers, store.sql("select 1 as x, '<b>' as y")):
        parsed = Parsed(thing._repr_html_())
        assert set(parsed.tags) <= PLAIN
        assert "table" in parsed.tags
    with pytest.raises(TopicError) as caught:
        store.topic("/mny")
    assert caught.value._render_traceback_() == [f"TopicError: {caught.value}"]
