"""No two topics meet in one collection."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from hybridlog_storage.mongo.index_documents import CATALOG_PREFIX, collection_of
from tests.format_reader import collection_name

# Few letters, so that names meet if they can.
NASTY = st.text(alphabet="/_a~.$ \0A0é", max_size=12)
ROS = st.lists(st.from_regex(r"[a-z0-9]{1,3}(_[a-z0-9]{1,2})?", fullmatch=True), min_size=1).map(
    lambda parts: "/" + "/".join(parts)
)


@given(NASTY | ROS | st.text(max_size=300))
def test_names_are_as_the_page_says(topic: str) -> None:
    assert collection_of(topic) == collection_name(topic)


@given(st.sets(NASTY | ROS | st.text(max_size=300), min_size=2, max_size=60))
def test_one_to_one(topics: set[str]) -> None:
    assert len({collection_of(topic) for topic in topics}) == len(topics)


@given(st.text(max_size=400) | NASTY | st.binary(max_size=20).map(lambda b: b.decode("latin-1")))
def test_mongodb_takes_every_name(topic: str) -> None:
    name = collection_of(topic)
    assert 0 < len(name.encode()) <= 160
    assert name.isascii()
    assert not set(name) & set("\0$. /")
    assert not name.startswith((CATALOG_PREFIX, "system."))


def test_halves_of_surrogate_pairs() -> None:
    assert collection_of("/\udc80") != collection_of("/\udc81")
