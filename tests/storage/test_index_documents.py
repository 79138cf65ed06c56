"""No two topics meet in one collection, and errors stand in the documents that they are of."""

from __future__ import annotations

import bson
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hybridlog_storage.messages import Batch, Channel
from hybridlog_storage.mongo.index_documents import (
    CATALOG_PREFIX,
    DocumentAssembler,
    collection_of,
)
from hybridlog_storage.segments.chunk import Placed, StoredChunk
from hybridlog_storage.segments.chunk_table import ChunkPlace
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


def test_errors_stand_in_the_documents_that_they_are_of() -> None:
    """None is too long, or stays in a document without."""
    assembler, rows = DocumentAssembler("fedcba9876543210", Channel("/ä", "x", None)), np.arange(3)
    none = np.zeros(3, np.int32)
    place = ChunkPlace(
        number=5, offset=2**41, length=100, trailer=50, first=0, last=0, channels=(1,)
    )
    batch = Batch(b"", rows * 34, np.full(3, 3), none, rows, rows, none)
    placed = Placed.of([StoredChunk(7, place, batch, rows)])
    for error in ("short", "ü" * 3000, "\udc80 half", None, *map(str, range(600)), "short", None):
        for row in assembler.assemble(placed, rows, np.empty((3, 0), np.uint8), error):
            document = bson.decode(row.tobytes())
            assert [*document] == ["_id", "_meta"]
            said = document["_meta"].get("error")
            wanted = None if error is None else error.encode("utf-8", "replace")[:1000].decode()
            assert said == wanted
