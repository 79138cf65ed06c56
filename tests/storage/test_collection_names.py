"""No two topics meet in one collection."""

from __future__ import annotations

import hashlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridlog_storage.mongo.collection_names import CATALOG_PREFIX, collection_of

# Few letters, so that names meet if they can.
NASTY = st.text(alphabet="/_a~.$ \0A0é", max_size=12)
ROS = st.lists(st.from_regex(r"[a-z0-9]{1,3}(_[a-z0-9]{1,2})?", fullmatch=True), min_size=1).map(
    lambda parts: "/" + "/".join(parts)
)


@pytest.mark.parametrize(
    ("topic", "name"),
    [
        ("/scan", "scan"),
        ("/r_gripper_controller/command", "r_gripper_controller__command"),
        ("/a/b", "a__b"),
        ("/camera/front/image_raw", "camera__front__image_raw"),
    ],
)
def test_canonical_names_stay_readable(topic: str, name: str) -> None:
    assert collection_of(topic) == name


@pytest.mark.parametrize(
    "topic", ["a/b", "/a__b", "//a/b", "/a/b/", "/a/_b", "/a_/b", "", "/", "/A b", "/ä", "/a\n"]
)
def test_all_others_have_their_hash(topic: str) -> None:
    digest = hashlib.sha256(topic.encode()).hexdigest()[:8]
    assert collection_of(topic).endswith(f"~{digest}")


@given(st.sets(NASTY | ROS | st.text(max_size=300), min_size=2, max_size=60))
def test_one_to_one(topics: set[str]) -> None:
    assert len({collection_of(topic) for topic in topics}) == len(topics)


def test_every_short_name_of_the_nasty_letters() -> None:
    names = {""}
    for _ in range(6):
        names |= {name + letter for name in names for letter in "/_ab"}
    assert len({collection_of(name) for name in names}) == len(names)


@given(ROS)
def test_canonical_names_can_be_undone(topic: str) -> None:
    name = collection_of(topic)
    if "~" not in name:
        assert "/" + name.replace("__", "/") == topic


@given(st.text(max_size=400) | NASTY | st.binary(max_size=20).map(lambda b: b.decode("latin-1")))
def test_mongodb_takes_every_name(topic: str) -> None:
    name = collection_of(topic)
    assert 0 < len(name.encode()) <= 160
    assert name.isascii()
    assert not set(name) & set("\0$. /")
    assert not name.startswith((CATALOG_PREFIX, "system."))


def test_halves_of_surrogate_pairs() -> None:
    assert collection_of("/\udc80") != collection_of("/\udc81")


def test_long_names_that_differ_at_the_end() -> None:
    one, other = "/" + "a" * 500 + "b", "/" + "a" * 500 + "c"
    assert collection_of(one) != collection_of(other)
    assert len(collection_of(one)) < 120
