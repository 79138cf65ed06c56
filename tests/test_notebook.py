"""What notebooks show, and what they complete."""

from __future__ import annotations

import io
import json
import struct
from base64 import b64decode
from collections.abc import Iterator
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

import hybridlog as hl
from hybridlog.drawing.notebook import message_html, recordings_html, shown
from hybridlog.drawing.pixels import SIDE
from hybridlog.message import Message
from hybridlog_storage.messages import Channel, Schema
from tests.test_snapshot import summary

HOSTILE = "<script>alert('x')</script>&\"\x1b[31m"
IMAGE = b"""std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
================================================================================
MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id
"""
COMPRESSED = IMAGE.replace(
    b"uint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\n",
    b"string format\n",
)
HEADER = struct.pack("<IIII", 0, 0, 0, 0)


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def image(encoding: str, array: np.ndarray) -> bytes:
    step = array.strides[0]
    size = struct.pack("<II", *array.shape[:2]) + text(encoding) + struct.pack("<BI", 0, step)
    return HEADER + size + struct.pack("<I", array.nbytes) + array.tobytes()


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    """Messages of hostile names and values, and pictures."""
    path = tmp_path_factory.mktemp("notebook")
    picture = io.BytesIO()
    Image.fromarray(np.full((300, 400, 3), (200, 10, 10), np.uint8)).save(picture, "PNG")
    colours = np.zeros((300, 400, 3), np.uint8)
    colours[:, :, 0] = 255  # blue, as OpenCV has it
    odd = {HOSTILE: HOSTILE, "nested": {"list": list(range(100))}, "long": "x" * 1000}
    many = {f"f{n}": n for n in range(50)}
    raw = Schema("sensor_msgs/Image", "ros1msg", IMAGE)
    packed = Schema("sensor_msgs/CompressedImage", "ros1msg", COMPRESSED)
    data = HEADER + text("png") + struct.pack("<I", picture.getbuffer().nbytes)
    with hl.open(path / "store", create=True) as opened:
        with opened.start(HOSTILE, tags={HOSTILE: HOSTILE}) as recording:
            for channel, payload in (
                (Channel(f"/{HOSTILE}", "json", None), json.dumps(odd).encode()),
                (Channel("/many", "json", None), json.dumps(many).encode()),
                (Channel("/image", "ros1", raw), image("bgr8", colours)),
                (Channel("/wrong", "ros1", raw), image("bgr8", colours)[:-5]),
                (Channel("/unknown", "ros1", raw), image("hsv99", colours)),
                (Channel("/packed", "ros1", packed), data + picture.getvalue()),
            ):
                recording.write(channel, payload, log_time=10**18)
        yield opened


class Parsed(HTMLParser):
    """The tags of HTML, its text, and the sources of its images."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.open: list[str] = []
        self.text = ""
        self.images: list[str] = []
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if tag == "img":
            self.images.append(dict(attrs)["src"] or "")
        else:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


PLAIN = {"div", "p", "b", "table", "thead", "tr", "th", "td", "img"}


def only(store: hl.Store, topic: str) -> Message:
    return next(iter(store.topic(topic)))


def test_names_and_values_are_text(store: hl.Store) -> None:
    recordings = store.recordings()
    hostile = only(store, f"/{HOSTILE}")
    for thing in (store, recordings, store.topic(f"/{HOSTILE}"), hostile):
        parsed = Parsed(thing._repr_html_())
        assert set(parsed.tags) <= PLAIN
        assert "alert('x')" in parsed.text or thing is recordings
    parsed = Parsed(hostile._repr_html_())
    assert HOSTILE in parsed.text
    assert "nested.list" in parsed.text
    assert "x" * 200 not in parsed.text
    assert "and" in Parsed(only(store, "/many")._repr_html_()).text


def test_output_is_bounded() -> None:
    made = [summary(n, (n, n), ["/a"], tags={"t": "v" * 10_000})[0] for n in range(1000)]
    html = recordings_html("many", made)
    assert len(html) < 20_000
    assert "and 980 earlier ones" in html
    assert ">r999<" in html
    assert ">r979<" not in html
    deep = {"deep": ["y" * 10_000] * 10_000}
    fields = {f"f{n}": deep for n in range(10_000)}
    html = message_html("m" * 10_000, fields, "", b"")
    assert len(html) < 20_000
    assert " and 9998 more]" in html
    assert html.count("<tr>") == 20
    assert shown("a\n  b" + "c" * 300, 10) == "a b" + "c" * 6 + "…"


def test_representations_are_short(store: hl.Store) -> None:
    path = store.directory.path
    assert repr(store) == f"<Store {path}>"
    (entry,) = store.recordings()
    assert repr(store.recordings()) == f"<Recordings {entry.name}>"
    assert repr(entry) == f"<Recording {entry.name}; 6 channels, 6 messages>"
    assert repr(entry.channels[1]) == "<Channel /many ; 1 messages>"
    query = store.topic("/many").between("+0s", "end").where("f1 > 0").limit(3)
    assert repr(query) == (
        f"<Query /many; recording {entry.name}; between +0s and end; where f1 > 0; at most 3>"
    )
    assert "at most 3" in Parsed(query._repr_html_()).text
    wide = store.all_topics().where(" or ".join(f"f{n} > {n}" for n in range(40)))
    assert len(repr(wide)) < 450
    assert "and 3 more" in repr(wide)


def test_images_have_a_thumbnail(store: hl.Store) -> None:
    for topic, colour in (("/image", (0, 0, 255)), ("/packed", (200, 10, 10))):
        (source,) = Parsed(only(store, topic)._repr_html_()).images
        assert source.startswith("data:image/png;base64,")
        with Image.open(io.BytesIO(b64decode(source.partition(",")[2]))) as seen:
            assert max(seen.size) <= SIDE
            assert seen.size == (134, 100)
            assert seen.getpixel((50, 50)) == colour
