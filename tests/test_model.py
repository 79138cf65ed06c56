"""The store against a list in memory, over whatever can happen to a store.

The model is a list of messages and a stable sort; it knows nothing of chunks or MongoDB,
and of segments only that they can be lost. Hypothesis records logs, removes, renames, tags
and marks recordings, moves and copies their directories, loses segments, manifests, the
catalog and the database, kills recorders at a random byte, and asks; every answer must be
the list's, in its order.
"""

from __future__ import annotations

import json
import random
import re
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import count, cycle
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import pymongo
import pymongo.database
import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from mcap.writer import CompressionType
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import hybridlog as hl
from hybridlog.query.query import Query
from hybridlog.query.topics import matcher
from hybridlog.record.recorder import RecordOptions
from hybridlog_storage.catalog import RecordingEntry
from hybridlog_storage.cells import CATALOG
from hybridlog_storage.errors import TimeError, TopicError
from hybridlog_storage.manifest import Manifest
from hybridlog_storage.manifest import replace as changed
from hybridlog_storage.manifests import MANIFEST_OLD
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.mongo.index_documents import IndexState
from hybridlog_storage.mongo.mongod import EmbeddedMongod
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.format_reader import Segment
from tests.independent import write_mcap
from tests.indexed import misindexed

pytestmark = pytest.mark.mongo("embedded")

BEGIN = 1_700_000_000 * 10**9
STEP = 40_000_000
STEPS = 30
"""Log times are `BEGIN + k * STEP`: few, so that many are equal."""
ARRAY_LIMIT = 32
SPOTS = 1 << 12

FIELDS = "std_msgs/Header header\nint32 number\nstring text\nfloat64[] data\n"
PLAIN = "int32 number\nstring text\nfloat64[] data\n"


def _stores() -> dict[str, Any]:
    stores = {"ros1": get_typestore(Stores.ROS1_NOETIC), "cdr": get_typestore(Stores.ROS2_HUMBLE)}
    for store in stores.values():
        store.register(get_types_from_msg(FIELDS, "x/msg/Stamped"))
        store.register(get_types_from_msg(PLAIN, "x/msg/Plain"))
    return stores


STORES = _stores()


@dataclass(frozen=True)
class Spec:
    """One connection of a synthetic log."""

    topic: str
    encoding: Literal["ros1", "cdr", "json", "cbor"]
    stamped: bool = True
    padding: int = 0
    who: str = ""


CHANNELS = (
    Spec("/a/b", "cdr"),
    Spec("a/b", "cdr", stamped=False),
    Spec("/a__b", "json"),
    Spec("/opaque", "cbor"),
    Spec("/twin", "cdr", who="one"),
    Spec("/twin", "cdr", stamped=False, who="two"),
    Spec("/big", "cdr", padding=1500),
    Spec("/ros1", "ros1"),
)
MARKS = "/hybridlog/marks"
TOPICS = sorted({MARKS, *(c.topic for c in CHANNELS)})
NAMES = {"run": "run", "calm sea": "calm sea", "x/y": "x-y", "log1": "log1", "\u00e9": "\u00e9"}
"""Names that people give, and those that recordings get."""


@dataclass(frozen=True)
class Draft:
    """What Hypothesis chooses of one message."""

    channel: int
    time: int
    published: int
    stamp: int
    number: int
    text: str
    count: int
    torn: bool


@dataclass(frozen=True)
class Said:
    """One message, as the model has it."""

    topic: str
    payload: bytes
    log_time: int
    published: int | None
    stamp: int | None
    """The header stamp, None where the message has none that can be read."""
    fields: dict[str, object] | None
    """What its index document holds; None for one that cannot be read."""
    torn: bool
    recording: str = ""
    seq: int = 0

    @property
    def order(self) -> tuple[int, str, int]:
        return self.log_time, self.recording[-16:], self.seq


def drafts_of(seed: int, size: int) -> list[Draft]:
    """Many messages for few choices of Hypothesis: a longer log tells more than a smaller one."""
    rng = random.Random(seed)
    calm = rng.random() < 0.5
    drafts = []
    for number in range(size):
        # Times mostly grow, some messages are late, and many are of the same moment.
        time = number * STEPS // max(size, 1) if calm else rng.randint(0, STEPS)
        long = rng.choice([0, 0, 0, 300, 1200, 5000])
        drafts.append(
            Draft(
                channel=rng.randint(0, 7),
                time=max(time - rng.choice([0, 0, 0, 5]), 0),
                published=max(time - rng.randint(0, 3), 0),
                stamp=max(time - rng.randint(0, 6), 0),
                number=rng.randint(-3, 3),
                text="".join(rng.choice("ab\u00e9\u4e2d\U0001f916 ") for _ in range(3))
                + "x" * long,
                count=rng.choice([0, 1, 2, ARRAY_LIMIT - 1, ARRAY_LIMIT, ARRAY_LIMIT + 1]),
                torn=rng.random() < 0.05,
            )
        )
    return drafts


drafts = st.builds(drafts_of, seed=st.integers(0, 1 << 30), size=st.integers(0, 90))
segment_settings = st.builds(
    SegmentSettings,
    chunk_size=st.sampled_from([1 << 10, 4 << 10, 1 << 20]),
    large_payload=st.sampled_from([200, 1024]),
    segment_size=st.sampled_from([6 << 10, 1 << 30]),
    compression=st.sampled_from(["zstd", "lz4", "none"]),
    sync=st.just("never"),
)


def said(spec: Spec, draft: Draft) -> Said:
    """The message of a draft, its payload written by somebody else's serializer."""
    text = (draft.text + "p" * spec.padding).replace("\0", "0")
    data = [draft.number + i / 4 for i in range(draft.count)]
    stamp = BEGIN + draft.stamp * STEP
    if spec.encoding == "json":
        values = {"number": draft.number, "text": text, "data": data}
        payload = json.dumps(values).encode()
    elif spec.encoding == "cbor":
        payload = text.encode()
    else:
        payload = _serialized(spec, draft.number, text, data, stamp)
    torn = draft.torn and spec.encoding != "cbor" and len(payload) > 4
    if torn:
        payload = payload[: len(payload) - 1 - draft.count % 3]
    fields: dict[str, object] | None = {}
    if torn:
        fields = None
    elif spec.encoding != "cbor":
        fields = {"number": draft.number, "text": text, "data": _indexed(data)}
        if spec.stamped and spec.encoding != "json":
            header: dict[str, object] = {"stamp": stamp, "frame_id": "f"}
            if spec.encoding == "ros1":
                header = {"seq": 7, **header}
            fields = {"header": header, **fields}
    has_stamp = fields is not None and "header" in fields
    return Said(
        spec.topic,
        payload,
        BEGIN + draft.time * STEP,
        BEGIN + draft.published * STEP,
        stamp if has_stamp else None,
        fields,
        torn,
    )


def _serialized(spec: Spec, number: int, text: str, data: list[float], stamp: int) -> bytes:
    types = STORES[spec.encoding]
    values = {"number": number, "text": text, "data": np.array(data, np.float64)}
    name = "x/msg/Plain"
    if spec.stamped:
        name = "x/msg/Stamped"
        time = types.types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
        sequence = {"seq": 7} if spec.encoding == "ros1" else {}
        values["header"] = types.types["std_msgs/msg/Header"](stamp=time, frame_id="f", **sequence)
    message = types.types[name](**values)
    write = types.serialize_ros1 if spec.encoding == "ros1" else types.serialize_cdr
    return bytes(write(message, name))


def _indexed(data: list[float]) -> object:
    if len(data) <= ARRAY_LIMIT:
        return data
    return {"n": len(data), "min": min(data), "max": max(data), "mean": sum(data) / len(data)}


def write_log(path: Path, chosen: Sequence[Draft]) -> list[Said]:
    """An MCAP file, by the official writer; its chunks are small."""
    schemas = {}
    for encoding, kind in (("cdr", "ros2msg"), ("ros1", "ros1msg")):
        for name in ("Stamped", "Plain"):
            definition, _ = STORES[encoding].generate_msgdef(
                f"x/msg/{name}", **({"ros_version": 2} if encoding == "cdr" else {})
            )
            full = f"x/msg/{name}" if encoding == "cdr" else f"x/{name}"
            schemas[encoding, name] = Schema(full, kind, definition.encode())
    channels = []
    for spec in CHANNELS:
        schema = schemas.get((spec.encoding, "Stamped" if spec.stamped else "Plain"))
        channels.append(Channel(spec.topic, spec.encoding, schema, {"who": spec.who}))
    out, rows = [], []
    for number, draft in enumerate(chosen):
        channel = draft.channel % len(channels)
        one = said(CHANNELS[channel], draft)
        rows.append((channels[channel], one.log_time, one.payload, one.published, number))
        out.append(one)
    write_mcap(path, rows, channels, chunk_size=2000, compression=CompressionType.ZSTD)
    return out


@dataclass(frozen=True)
class Asked:
    """A question."""

    topics: tuple[str, ...]
    bounds: tuple[int, int] | None
    number: int | None
    """`where number >= …`."""
    reverse: bool


bounds = st.tuples(st.integers(0, STEPS), st.integers(1, STEPS)).map(
    lambda b: (BEGIN + b[0] * STEP, BEGIN + (b[0] + b[1]) * STEP)
)
questions = st.builds(
    Asked,
    topics=st.just(()),
    bounds=st.none() | bounds,
    number=st.none() | st.integers(-3, 4),
    reverse=st.booleans(),
)


@dataclass(frozen=True)
class Lost:
    """A segment that was taken away.

    Attributes:
        content: Its bytes.
        messages: What was in it.
    """

    content: bytes
    messages: list[Said]


@dataclass
class Recording:
    """A recording, as the model has it."""

    messages: list[Said]
    channels: set[str]
    name: str
    tags: dict[str, str]
    status: str = "complete"
    notes: list[str] = field(default_factory=list)
    marks: list[tuple[int, str]] = field(default_factory=list)
    lost: dict[int, Lost] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.first_name, self.first_tags = self.name, dict(self.tags)

    @property
    def topics(self) -> set[str]:
        """All that it has or had: one of which all messages are lost is still known."""
        lost = {m.topic for lost in self.lost.values() for m in lost.messages}
        return lost | self.channels

    @property
    def findings(self) -> Counter[tuple[str, str]]:
        """What `verify` must find: name and place."""
        found = Counter((self.name, f"{number:06d}.mcap") for number in self.lost)
        if self.status == "unproven":
            found[self.name, "manifest"] += 1
        return found


class Machine(RuleBasedStateMachine):
    """A store and its model."""

    path: ClassVar[Path]
    uri: ClassVar[str]
    logs: ClassVar[Path]

    def __init__(self) -> None:
        super().__init__()
        self.model: dict[str, Recording] = {}
        self.changed = True
        self.written = 0
        self.store = hl.open(self.path, create=True, require_database=True)
        for recording in self.store.recordings():
            self.store.remove(recording.id)

    def teardown(self) -> None:
        self.store.close()

    # What happens to a store.

    @initialize(chosen=drafts, settings=segment_settings)
    def begin(self, chosen: list[Draft], settings: SegmentSettings) -> None:
        self.record(chosen, settings)

    @rule(
        chosen=drafts,
        settings=segment_settings,
        wanted=st.none() | st.lists(st.sampled_from(TOPICS), min_size=1, unique=True),
        between=st.none() | bounds,
    )
    def record(
        self,
        chosen: list[Draft],
        settings: SegmentSettings,
        wanted: list[str] | None = None,
        between: tuple[int, int] | None = None,
    ) -> None:
        self.written += 1
        path = self.logs / f"log{self.written}.mcap"
        everything = write_log(path, chosen)
        kept = [
            m
            for m in everything
            if (wanted is None or m.topic in wanted)
            and (between is None or between[0] <= m.log_time < between[1])
        ]
        tags = {"kind": "log"} if self.written % 2 else {}
        options = RecordOptions(
            settings=settings,
            tags=tags,
            matcher=None if wanted is None else matcher([_exactly(t) for t in wanted]),
            between=between,
            again=True,
        )
        before = self.store.directory.ids()
        if wanted is not None and not kept:
            with pytest.raises(TopicError):
                self.store.record(path, options)
            assert self.store.directory.ids() == before
            path.unlink()
            return
        report = self.store.record(path, options)
        path.unlink()
        assert report.failure is None
        assert not report.damage
        assert report.indexed == len(kept)
        assert report.skipped == len(everything) - len(kept)
        entry = report.entry
        numbered = [replace(m, recording=entry.id, seq=seq) for seq, m in enumerate(kept)]
        # Channels without messages are kept, too.
        channels = {spec.topic for spec in CHANNELS if wanted is None or spec.topic in wanted}
        self.model[entry.id] = Recording(numbered, channels, self.free_name(path.stem), tags)
        self.changed = True

    @precondition(lambda self: self.model)
    @rule(which=st.integers(0, 9))
    def remove(self, which: int) -> None:
        recording = self.chosen(which)
        self.store.remove(recording)
        del self.model[recording]
        self.changed = True

    @rule()
    def reopen(self) -> None:
        self.open_again()
        assert mended(self.store) == set()

    @rule()
    def lose_the_database(self) -> None:
        assert self.store.shared.index.reached() is not None
        name = self.store.shared.index.reached().name
        with pymongo.MongoClient[dict[str, Any]](self.uri) as client:
            client.drop_database(name)
        self.open_again()
        assert set(self.store.shared.repairs.indexed) == {k.name for k in self.model.values()}
        self.changed = True

    @rule(how=st.sampled_from(["deleted", "page", "byte"]), spot=st.integers(0, SPOTS))
    def lose_the_catalog(self, how: str, spot: int) -> None:
        """Whatever of the catalog is gone or changed is made again, and nobody has to ask."""
        self.store.close()
        path = self.path / CATALOG
        if how == "deleted":
            path.unlink()
        else:
            content = bytearray(path.read_bytes())
            begin = spot % len(content)
            size = 4096 if how == "page" else 1
            content[begin : begin + size] = bytes(len(content[begin : begin + size]))
            path.write_bytes(content)
        self.store = hl.open(self.path, require_database=True)
        topics = tuple(sorted({t for k in self.model.values() for t in k.topics}))
        if topics:
            check(self.store, self.model, Asked(topics, None, None, reverse=False))
        assert not self.store.shared.repairs.removed
        assert {f.place for f in self.store.verify().findings} == self.places()
        self.open_again()  # what only decoding tells is found out now, if a question missed it
        self.changed = True

    def places(self) -> set[str]:
        """What `verify` must tell of whatever the catalog is."""
        return {place for known in self.model.values() for _, place in known.findings}

    @rule()
    def rebuild(self) -> None:
        assert {r.id for r in self.store.index.rebuild()} == set(self.model)
        self.changed = True

    # What people do to a recording.

    @precondition(lambda self: self.model)
    @rule(which=st.integers(0, 9), name=st.sampled_from(sorted(NAMES)))
    def rename(self, which: int, name: str) -> None:
        recording = self.chosen(which)
        known = self.model[recording]
        known.name = self.free_name(NAMES[name], but=known.name)
        assert self.store.edit(recording, name=name).name == known.name
        self.changed = True

    @precondition(lambda self: self.model)
    @rule(
        which=st.integers(0, 9),
        tags=st.dictionaries(
            st.sampled_from(["kind", "place", "a.b"]), st.sampled_from(["", "$x", "\u4e2d"])
        ),
        untagged=st.booleans(),
    )
    def tag(self, which: int, tags: dict[str, str], untagged: bool) -> None:
        recording = self.chosen(which)
        known = self.model[recording]
        if untagged and known.tags:
            gone = min(known.tags)
            del known.tags[gone]
            self.store.edit(recording, untag=[gone])
        known.tags |= tags
        assert self.store.edit(recording, tag=tags).tags == known.tags
        self.changed = True

    @precondition(lambda self: self.model)
    @rule(which=st.integers(0, 9), text=st.sampled_from(["it rained", '\u00e9\n"x"']))
    def note(self, which: int, text: str) -> None:
        recording = self.chosen(which)
        self.model[recording].notes.append(text)
        self.store.edit(recording, note=text)
        self.changed = True

    @precondition(lambda self: self.model)
    @rule(
        which=st.integers(0, 9), time=st.integers(0, STEPS), text=st.sampled_from(["hit", "\u00e9"])
    )
    def mark(self, which: int, time: int, text: str) -> None:
        recording = self.chosen(which)
        known = self.model[recording]
        moment = BEGIN + time * STEP
        begin, end = self.store.recordings(recording).summaries[0].extent
        has_messages = any(said.topic != MARKS for said in known.messages)
        if has_messages and not begin <= moment <= end:
            with pytest.raises(TimeError, match=r"begins at|ends at"):
                self.store.mark(recording, moment, text, {"k": text})
            return
        self.store.mark(recording, moment, text, {"k": text})
        known.marks.append((moment, text))
        known.channels.add(MARKS)
        content = {"text": text, "tags": {"k": text}}
        payload = json.dumps(content, ensure_ascii=False).encode()
        # Its arrival number is one that no message ever had.
        told = max(self.store.query([MARKS], [recording]), key=lambda message: message.seq)
        taken = [*known.messages, *(m for lost in known.lost.values() for m in lost.messages)]
        assert all(m.seq < told.seq for m in taken)
        said = Said(MARKS, payload, moment, moment, None, content, torn=False)
        known.messages.append(replace(said, recording=recording, seq=told.seq))
        self.changed = True

    # What happens to directories and files.

    @precondition(lambda self: self.model)
    @rule(which=st.integers(0, 9), segment=st.integers(0, 9), reopened=st.booleans())
    def lose_a_segment(self, which: int, segment: int, reopened: bool) -> None:
        recording = self.chosen(which)
        known = self.model[recording]
        segments = places.segments(self.store.directory.path, recording)
        if not segments:
            return
        number, path = segments[segment % len(segments)]
        gone = {seq for part in arrivals_of(Segment(path)) for seq in part}
        lost = Lost(path.read_bytes(), [m for m in known.messages if m.seq in gone])
        assert {m.seq for m in lost.messages} == gone
        path.unlink()
        known.lost[number] = lost
        known.messages = [m for m in known.messages if m.seq not in gone]
        if reopened:
            self.open_again()
        else:
            self.store.refresh()
            self.store.index.rebuild([recording])
        self.take_channels(recording)
        self.changed = True

    @precondition(lambda self: any(known.lost for known in self.model.values()))
    @rule(which=st.integers(0, 9))
    def restore_a_segment(self, which: int) -> None:
        recording = self.chosen(which, lambda known: bool(known.lost))
        known = self.model[recording]
        number, lost = known.lost.popitem()
        path = places.segment(self.store.directory.path, recording, number)
        path.write_bytes(lost.content)
        known.messages += lost.messages
        self.open_again()
        self.take_channels(recording)
        self.changed = True

    @precondition(lambda self: any(not known.lost for known in self.model.values()))
    @rule(which=st.integers(0, 9), has_old=st.booleans())
    def lose_a_manifest(self, which: int, has_old: bool) -> None:
        """What people wrote last is gone, no message is, and nobody calls it proven again."""
        recording = self.chosen(which, lambda known: not known.lost)
        known = self.model[recording]
        folder = places.folder(self.store.directory.path, recording)
        self.store.edit(recording, note="the last change")
        places.manifest_of(folder).unlink()
        known.status = "unproven"
        if not has_old:
            (folder / MANIFEST_OLD).unlink()
            known.name = self.free_name(known.first_name, but=known.name)
            known.tags = dict(known.first_tags)
            known.notes.clear()
            known.marks.clear()
            known.messages = [m for m in known.messages if m.topic != MARKS]
        self.open_again()
        assert self.store.shared.repairs.unreadable.keys() == {recording}
        assert recording not in {one.id for one in self.store.recordings()}
        cured = [one.place for one in self.store.verify(repair=True).repaired]
        assert "manifest" in cured
        self.open_again()
        assert not self.store.shared.repairs.unreadable
        assert not self.store.shared.repairs.removed
        self.take_channels(recording)
        self.changed = True

    # What is drawn must not depend on file sizes: they vary with random ids and times.
    @precondition(lambda self: any(map(can_crash, self.model.values())))
    @rule(
        which=st.integers(0, 9),
        spot=st.integers(0, SPOTS),
        part=st.sampled_from(["file", "chunk", "trailer", "sealed"]),
        indexed=st.lists(st.booleans(), min_size=5, max_size=5),
        has_half=st.booleans(),
    )
    def crash(
        self,
        which: int,
        spot: int,
        part: Literal["file", "chunk", "trailer", "sealed"],
        indexed: list[bool],
        has_half: bool,
    ) -> None:
        """Put a recording in the state in which a killed recorder leaves it."""
        recording = self.chosen(which, can_crash)
        known = self.model[recording]
        entry = self.store.entry(recording)
        number, path = places.segments(self.store.directory.path, recording)[-1]
        segment = Segment(path)
        arrivals, cut = arrivals_of(segment), end_of(segment, spot, part)
        whole = [n for n, chunk in enumerate(segment.chunks) if sum(chunk[:3]) <= cut]
        database = self.store.shared.index.reached()
        assert database is not None
        with pymongo.MongoClient[dict[str, Any]](self.uri) as client:
            # Log first, index second: the index is behind the file by some chunks, and of one
            # it may have documents that it does not count.
            kept = whole[: sum(is_in for _, is_in in zip(whole, cycle(indexed), strict=False))]
            kept += whole[len(kept) : len(kept) + has_half]
            fall_back(client[database.name], recording, number, kept)
        others = {n: digest for n, digest in entry.digests.items() if n != str(number)}
        if others:
            IndexState(database).put_segments(entry.key, others)
        # The manifest lists the segment, or nothing from there on.
        change_manifest(path.parent, None if part == "sealed" else number, status="open")
        path.with_name(path.name + ".open").write_bytes(segment.data[:cut])
        path.unlink()
        self.open_again()
        self.changed = True
        by_seq = {m.seq: m for m in known.messages}
        in_segment = {seq for part in arrivals for seq in part}
        survivors = {seq: m for seq, m in by_seq.items() if seq not in in_segment}
        assert list(self.store.shared.repairs.recovered) == [known.name]
        survivors |= {seq: by_seq[seq] for n in whole for seq in arrivals[n]}
        described = min(offset + length for offset, length, _ in segment.metadata)
        if number == 0 and described > cut and not known.marks:
            assert recording not in self.store.directory.ids()
            del self.model[recording]
            return
        known.messages = list(survivors.values())
        self.take_channels(recording)
        # What was sealed says itself how the recording ended.
        known.status = known.status if part == "sealed" else "recovered"

    def take_channels(self, recording: str) -> None:
        """Of the channels that there are, all that have messages must be known."""
        known = self.model[recording]
        known.channels = {channel.topic for channel in self.store.entry(recording).channels}
        assert {message.topic for message in known.messages} <= known.channels

    # What is asked.

    @rule(asked=st.lists(questions, min_size=6, max_size=10), bits=st.integers(0, 1 << 90))
    def ask(self, asked: list[Asked], bits: int) -> None:
        for question in asked:
            topics = tuple(t for i, t in enumerate(TOPICS) if bits >> i & 1)
            bits >>= len(TOPICS)
            question = replace(question, topics=topics or ("/absent",))
            check(self.store, self.model, question)

    @invariant()
    def everything_is_there(self) -> None:
        if not self.changed:
            return
        self.changed = False
        entries = {r.id: r for r in self.store.recordings()}
        assert set(entries) == set(self.model)
        assert self.model.keys() == set(self.store.directory.ids())
        findings: Counter[tuple[str, str]] = Counter()
        for name, known in self.model.items():
            entry = entries[name]
            compare(entry, known)
            findings += known.findings
        result = self.store.verify()
        assert Counter((f.recording, f.place) for f in result.findings) == findings
        assert result.messages == sum(len(k.messages) for k in self.model.values())
        topics = tuple(sorted({t for k in self.model.values() for t in k.topics}))
        assert tuple(self.store.topics()) == topics
        self.store.shared.index.connect()
        assert misindexed(self.store) == {}
        if topics:
            check(self.store, self.model, Asked(topics, None, None, reverse=False))
        for topic in topics:
            check(self.store, self.model, Asked((topic,), None, None, reverse=True))

    def chosen(self, which: int, fits: Callable[[Recording], bool] = lambda _: True) -> str:
        able = [name for name, known in self.model.items() if fits(known)]
        return able[which % len(able)]

    def free_name(self, base: str, *, but: str = "") -> str:
        """The name that a recording gets for which this one is wanted."""
        taken = {known.name for known in self.model.values()} - {but}
        names = (base if n == 1 else f"{base}-{n}" for n in count(1))
        return next(name for name in names if name not in taken)

    def open_again(self) -> None:
        self.store.close()
        self.store = hl.open(self.path, require_database=True)


def compare(entry: RecordingEntry, known: Recording) -> None:
    """Hold what the store says of a recording against the model."""
    assert entry.messages == len(known.messages)
    assert (entry.name, entry.tags) == (known.name, known.tags)
    assert [note.text for note in entry.manifest.notes] == known.notes
    assert [(mark.time, mark.text) for mark in entry.manifest.marks] == known.marks
    times = [m.log_time for m in known.messages]
    assert entry.span == ((min(times), max(times)) if times else None)
    stats = [c.stats for c in entry.channels]
    assert sum(s.unreadable for s in stats) == sum(m.torn for m in known.messages)
    stamps = [m.stamp for m in known.messages if m.stamp is not None]
    assert sum(s.stamped for s in stats) == len(stamps)
    assert min((s.first_stamp for s in stats if s.first_stamp is not None), default=None) == min(
        stamps, default=None
    )
    # A segment that is gone is a loss of just its messages, and no other.
    assert entry.status == ("damaged" if known.lost else known.status)
    losses: Counter[str] = Counter()
    for row in entry.losses:
        assert row["cause"] == "segment"
        losses[str(row["topic"])] += row["count"]
    losses = Counter({topic: number for topic, number in losses.items() if number})
    gone = (m.topic for lost in known.lost.values() for m in lost.messages)
    assert losses == Counter(gone)


def mended(store: hl.Store) -> set[str]:
    """What the opening of a store had to put right, by the names of `RepairReport`."""
    repairs = store.shared.repairs
    return {name for name in repairs.__struct_fields__ if getattr(repairs, name)}


def can_crash(known: Recording) -> bool:
    """Whether it can be as if its recorder had been killed: it lacks nothing else."""
    return not known.lost and known.status != "unproven"


def change_manifest(folder: Path, without: int | None, **values: Any) -> None:
    """As it was before a segment was listed."""

    def how(now: Manifest) -> Manifest:
        files = tuple(one for one in now.files if one.number != without)
        return changed(now, files=files, **values)

    places.change_in(folder, how)


def _exactly(topic: str) -> str:
    return f"re:^{re.escape(topic)}$"


# The model's answers.


def expected(model: dict[str, Recording], asked: Asked) -> list[Said] | type[Exception]:
    """The answer: messages in order, or the error."""
    wanted = set(asked.topics)
    recordings = [k for k in model.values() if k.topics & wanted]
    if not recordings:
        return TopicError
    everything = [m for k in recordings for m in k.messages if m.topic in wanted]
    if asked.bounds is not None:
        begin, end = asked.bounds
        spans = [
            (min(m.log_time for m in k.messages), max(m.log_time for m in k.messages))
            for k in recordings
            if k.messages and k.channels & wanted
        ]
        # Where all messages of a topic are lost nobody says that there were none.
        has_channels = any(k.channels & wanted for k in recordings)
        if has_channels and not any(first < end and last >= begin for first, last in spans):
            return TimeError
        everything = [m for m in everything if begin <= m.log_time < end]
    if asked.number is not None:
        everything = [m for m in everything if _number(m) >= asked.number]
    everything.sort(key=lambda m: m.order, reverse=asked.reverse)
    return everything


def _number(message: Said) -> float:
    number = (message.fields or {}).get("number", float("-inf"))
    assert isinstance(number, int | float)
    return number


def query_of(store: hl.Store, asked: Asked) -> Query:
    query = store.query(asked.topics)
    if asked.bounds is not None:
        query = query.between(*asked.bounds)
    if asked.number is not None:
        query = query.where(f"number >= {asked.number}")
    return query.reverse() if asked.reverse else query


def outcome(answer: Callable[[], Any]) -> Any:
    """What an answer is, or of which class its error."""
    try:
        return answer()
    except (TopicError, TimeError) as error:
        return type(error)


def check(store: hl.Store, model: dict[str, Recording], asked: Asked) -> None:
    """Ask the store and the model."""
    want = expected(model, asked)
    got = outcome(lambda: [seen(m) for m in query_of(store, asked)])
    if not isinstance(want, list):
        assert got is want
        assert outcome(lambda: query_of(store, asked).count()) is want
        return
    assert got == [(m.topic, m.recording, m.seq, m.log_time, m.published, m.payload) for m in want]
    assert query_of(store, asked).count() == len(want)


def seen(message: hl.Message) -> tuple[object, ...]:
    return (
        message.topic,
        message.recording,
        message.seq,
        message.log_time_ns,
        message.publish_time_ns,
        message.raw,
    )


def end_of(segment: Segment, spot: int, part: str) -> int:
    """A byte at which the file may end: anywhere, in a chunk, or in what follows one."""
    start, end = 0, int(struct.unpack_from("<Q", segment.data, len(segment.data) - 28)[0]) - 13
    if part == "sealed":
        return len(segment.data)
    if part != "file" and segment.chunks:
        chunk = segment.chunks[spot % len(segment.chunks)]
        start, end = chunk.offset, chunk.offset + chunk.length
        if part == "trailer":
            start, end = end, end + chunk.trailer
    return start + (end - start) * spot // SPOTS


def arrivals_of(segment: Segment) -> list[list[int]]:
    """Arrival numbers of each chunk's messages."""
    return [[told.seq for _, told in segment.chunk(n)] for n in range(len(segment.chunks))]


def fall_back(database: Any, recording: str, number: int, kept: Sequence[int]) -> None:
    """Forget the documents of all chunks of a segment but some, and that all is there."""
    key = recording[-16:]
    lost = {"_meta.rec": key, "_meta.ref.seg": number, "_meta.ref.chunk": {"$nin": [*kept]}}
    for name in database.list_collection_names():
        if not name.startswith("hybridlog."):
            database[name].delete_many(lost)
    begun = {"made": "", "segments": {}}
    database["hybridlog.recordings"].update_one({"_id": key}, {"$set": begun})


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[type[Machine]]:
    base = tmp_path_factory.mktemp("model")
    Machine.path, Machine.logs = base / "store", base
    with hl.open(Machine.path, create=True):
        # Held throughout, so that the machines need not start mongod each.
        with EmbeddedMongod(Machine.path / "mongod") as mongod:
            Machine.uri = mongod.start()
            yield Machine


def small() -> SegmentSettings:
    return SegmentSettings(chunk_size=1 << 10, segment_size=6 << 10, sync="never")


def test_whatever_happens_happens(machine: type[Machine]) -> None:
    """What chance may leave out: each rule once, in an order that makes it hard."""
    model = machine()
    indexed = [True, False, True, True, False]
    again = {"indexed": indexed, "has_half": True}
    steps: list[Callable[[], object]] = [
        lambda: model.record(drafts_of(85, 70), small()),
        lambda: model.lose_a_segment(0, 1, reopened=False),
        lambda: model.lose_a_segment(0, 0, reopened=True),
        lambda: model.mark(0, 3, "hit"),
        lambda: model.rename(0, "x/y"),
        lambda: model.lose_the_catalog("deleted", 0),
        lambda: model.restore_a_segment(0),
        model.rebuild,
        lambda: model.restore_a_segment(0),
        lambda: model.mark(0, 5, "\u00e9"),
        lambda: model.record(drafts_of(12, 60), small()),
        lambda: model.crash(0, SPOTS // 3, "trailer", **again),  # type: ignore[arg-type]
        lambda: model.crash(0, SPOTS // 2, "chunk", **again),  # type: ignore[arg-type]
        lambda: model.crash(0, 0, "sealed", **again),  # type: ignore[arg-type]
        lambda: model.tag(0, {"kind": "$x"}, untagged=False),
        lambda: model.note(1, "it rained"),
        model.lose_the_database,
        lambda: model.lose_a_manifest(0, has_old=True),
        lambda: model.lose_a_manifest(0, has_old=False),
        lambda: model.mark(0, 7, "hit"),
        lambda: model.lose_a_segment(0, 9, reopened=True),
        lambda: model.lose_the_catalog("row", 1),
        lambda: model.remove(0),
        model.reopen,
    ]
    try:
        for step in steps:
            step()
            model.everything_is_there()
    finally:
        model.teardown()


@pytest.mark.parametrize(
    ("examples", "steps"),
    [
        (1, 25),
        pytest.param(60, 30, marks=[pytest.mark.exhaustive, pytest.mark.timeout(3600)]),
    ],
)
def test_the_store_is_its_model(machine: type[Machine], examples: int, steps: int) -> None:
    run_state_machine_as_test(
        machine,
        settings=settings(
            max_examples=examples,
            stateful_step_count=steps,
            deadline=None,
            phases=(Phase.generate,),
            derandomize=examples == 1,
            suppress_health_check=list(HealthCheck),
        ),
    )
