"""The store against a list in memory, over whatever can happen to a store.

The model is a list of messages and a stable sort; it knows nothing of chunks, segments
or MongoDB. Hypothesis records logs, removes recordings, loses the database, kills
recorders at a random byte, and asks; every answer must be the list's, in its order.
"""

from __future__ import annotations

import json
import random
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from itertools import cycle
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
from mcap.writer import CompressionType, Writer
from rosbags.interfaces import ConnectionExtRosbag1
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import hybridlog as hl
from hybridlog.query.topics import matcher
from hybridlog.reader import Query
from hybridlog.recorder import RecordOptions
from hybridlog_storage.errors import TimeError, TopicError
from hybridlog_storage.mongod import EmbeddedMongod
from hybridlog_storage.segment_writer import SegmentSettings

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


MCAP_CHANNELS = (
    Spec("/a/b", "cdr"),
    Spec("a/b", "cdr", stamped=False),
    Spec("/a__b", "json"),
    Spec("/opaque", "cbor"),
    Spec("/twin", "cdr", who="one"),
    Spec("/twin", "cdr", stamped=False, who="two"),
    Spec("/big", "cdr", padding=1500),
    Spec("/ros1", "ros1"),
)
BAG_CHANNELS = (
    Spec("/a/b", "ros1"),
    Spec("/twin", "ros1", who="one"),
    Spec("/twin", "ros1", who="two"),
    Spec("/big", "ros1", padding=2500),
    Spec("/plain", "ros1", stamped=False),
)
TOPICS = sorted({c.topic for c in (*MCAP_CHANNELS, *BAG_CHANNELS)})


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
    has_header: bool
    """Whether its type has one."""
    recording: str = ""
    key: int = 0
    seq: int = 0

    @property
    def order(self) -> tuple[int, int, int]:
        return self.log_time, self.key, self.seq


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


def said(spec: Spec, draft: Draft, bag: bool) -> Said:
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
        None if bag else BEGIN + draft.published * STEP,
        stamp if has_stamp else None,
        fields,
        torn,
        spec.stamped and spec.encoding in {"ros1", "cdr"},
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


def write_mcap(path: Path, chosen: Sequence[Draft]) -> list[Said]:
    """An MCAP file, by the official writer; its chunks are small."""
    out: list[Said] = []
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=2000, compression=CompressionType.ZSTD)
        writer.start(profile="ros2")
        schemas = {}
        for encoding, kind in (("cdr", "ros2msg"), ("ros1", "ros1msg")):
            for name in ("Stamped", "Plain"):
                definition, _ = STORES[encoding].generate_msgdef(
                    f"x/msg/{name}", **({"ros_version": 2} if encoding == "cdr" else {})
                )
                full = f"x/msg/{name}" if encoding == "cdr" else f"x/{name}"
                schemas[encoding, name] = writer.register_schema(full, kind, definition.encode())
        ids = []
        for spec in MCAP_CHANNELS:
            schema = schemas.get((spec.encoding, "Stamped" if spec.stamped else "Plain"), 0)
            ids.append(
                writer.register_channel(spec.topic, spec.encoding, schema, {"who": spec.who})
            )
        for number, draft in enumerate(chosen):
            channel = draft.channel % len(MCAP_CHANNELS)
            message = said(MCAP_CHANNELS[channel], draft, bag=False)
            assert message.published is not None
            writer.add_message(
                ids[channel], message.log_time, message.payload, message.published, number
            )
            out.append(message)
        writer.finish()  # type: ignore[no-untyped-call]
    return out


def write_bag(path: Path, chosen: Sequence[Draft]) -> list[Said]:
    """A ROS 1 bag, by `rosbags`; several connections share a topic."""
    out: list[Said] = []
    writer = BagWriter(path)
    writer.chunk_threshold = 2000
    with writer:
        ids = []
        for spec in BAG_CHANNELS:
            name = f"x/msg/{'Stamped' if spec.stamped else 'Plain'}"
            made = writer.add_connection(
                spec.topic, name, typestore=STORES["ros1"], callerid=f"/{spec.who}"
            )
            assert isinstance(made.ext, ConnectionExtRosbag1)
            ids.append(made)
        for draft in chosen:
            channel = draft.channel % len(BAG_CHANNELS)
            message = said(BAG_CHANNELS[channel], draft, bag=True)
            writer.write(ids[channel], message.log_time, message.payload)
            out.append(message)
    return out


@dataclass(frozen=True)
class Asked:
    """A question."""

    topics: tuple[str, ...]
    bounds: tuple[int, int] | None
    clock: Literal["log", "publish", "header"]
    number: int | None
    """`where number >= …`."""
    limit: int | None
    every: int
    reverse: bool


bounds = st.tuples(st.integers(0, STEPS), st.integers(1, STEPS)).map(
    lambda b: (BEGIN + b[0] * STEP, BEGIN + (b[0] + b[1]) * STEP)
)
questions = st.builds(
    Asked,
    topics=st.just(()),
    bounds=st.none() | bounds,
    clock=st.sampled_from(["log", "publish", "header"]),
    number=st.none() | st.integers(-3, 4),
    limit=st.none() | st.integers(0, 5),
    every=st.sampled_from([1, 1, 2, 3]),
    reverse=st.booleans(),
)


@dataclass
class Recording:
    """A recording, as the model has it."""

    messages: list[Said]
    is_bag: bool
    channels: set[tuple[str, bool]]
    """Topic, and whether its type has a header, of each channel the store knows of."""
    status: str = "complete"

    @property
    def topics(self) -> set[str]:
        return {topic for topic, _ in self.channels}


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
        self.record_log(chosen, settings, is_bag=False)

    @rule(
        chosen=drafts,
        is_bag=st.booleans(),
        settings=segment_settings,
        wanted=st.none() | st.lists(st.sampled_from(TOPICS), min_size=1, unique=True),
        between=st.none() | bounds,
    )
    def record(
        self,
        chosen: list[Draft],
        is_bag: bool,
        settings: SegmentSettings,
        wanted: list[str] | None,
        between: tuple[int, int] | None,
    ) -> None:
        self.record_log(chosen, settings, is_bag=is_bag, wanted=wanted, between=between)

    def record_log(
        self,
        chosen: list[Draft],
        settings: SegmentSettings,
        *,
        is_bag: bool,
        wanted: list[str] | None = None,
        between: tuple[int, int] | None = None,
    ) -> None:
        self.written += 1
        path = self.logs / f"log{self.written}{'.bag' if is_bag else '.mcap'}"
        everything = (write_bag if is_bag else write_mcap)(path, chosen)
        kept = [
            m
            for m in everything
            if (wanted is None or m.topic in wanted)
            and (between is None or between[0] <= m.log_time < between[1])
        ]
        options = RecordOptions(
            settings=settings,
            matcher=None if wanted is None else matcher([_exactly(t) for t in wanted]),
            between=between,
            again=True,
        )
        before = self.store.directory.recording_ids()
        if wanted is not None and not kept:
            with pytest.raises(TopicError):
                self.store.record(path, options)
            assert self.store.directory.recording_ids() == before
            path.unlink()
            return
        report = self.store.record(path, options)
        path.unlink()
        assert report.failure is None
        assert not report.damage
        assert report.indexed == len(kept)
        assert report.skipped == len(everything) - len(kept)
        entry = report.entry
        numbered = [
            replace(m, recording=entry.id, key=entry.key, seq=seq) for seq, m in enumerate(kept)
        ]
        channels = {(m.topic, m.has_header) for m in kept}
        self.model[entry.id] = Recording(numbered, is_bag, channels)
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
        assert not self.store.tended.recovered
        assert not self.store.tended.indexed
        assert not self.store.tended.removed

    @rule()
    def lose_the_database(self) -> None:
        assert self.store.database is not None
        name = self.store.database.name
        with pymongo.MongoClient[dict[str, Any]](self.uri) as client:
            client.drop_database(name)
        self.open_again()
        assert set(self.store.tended.indexed) == set(self.model)
        self.changed = True

    @rule()
    def reindex(self) -> None:
        assert {r.id for r in self.store.reindex()} == set(self.model)
        self.changed = True

    # What is drawn must not depend on file sizes: they vary with random keys and times.
    @precondition(lambda self: self.model)
    @rule(
        which=st.integers(0, 9),
        spot=st.integers(0, SPOTS),
        part=st.sampled_from(["file", "chunk", "trailer"]),
        indexed=st.lists(st.booleans(), min_size=5, max_size=5),
        has_half=st.booleans(),
    )
    def crash(
        self,
        which: int,
        spot: int,
        part: Literal["file", "chunk", "trailer"],
        indexed: list[bool],
        has_half: bool,
    ) -> None:
        """Put a recording in the state in which a killed recorder leaves it."""
        recording = self.chosen(which)
        known = self.model[recording]
        number, path = self.store.directory.segments(recording)[-1]
        content = path.read_bytes()
        laid = Laid.out(content)
        cut = laid.cut(spot, part)
        whole = [c for c in laid.chunks if c.arrivals_end <= cut]
        torn = [c for c in laid.chunks if c.end <= cut < c.arrivals_end]
        assert self.store.database is not None
        with pymongo.MongoClient[dict[str, Any]](self.uri) as client:
            index = Index(client[self.store.database.name], recording, number)
            arrivals = index.arrivals()
            assert arrivals.keys() == {c.offset for c in laid.chunks}
            # Log first, index second: the index is behind the file by any of its chunks,
            # and of one it may have documents only.
            kept = [c.offset for c, is_in in zip(whole, cycle(indexed), strict=False) if is_in]
            half = [c.offset for c in whole if c.offset not in kept][:1]
            index.fall_back_to(kept, half if has_half else [])
        path.with_name(path.name + ".open").write_bytes(content[:cut])
        path.unlink()
        self.open_again()
        assert list(self.store.tended.recovered) == [recording]
        by_seq = {m.seq: m for m in known.messages}
        in_segment = {seq for part in arrivals.values() for seq in part}
        survivors = {seq: m for seq, m in by_seq.items() if seq not in in_segment}
        survivors |= {seq: by_seq[seq] for c in whole for seq in arrivals[c.offset]}
        for chunk in torn:
            # Its arrival numbers are lost: it arrived after all else, in its own order.
            with pymongo.MongoClient[dict[str, Any]](self.uri) as client:
                index = Index(client[self.store.database.name], recording, number)
                new = index.arrivals()[chunk.offset]
            assert new == list(range(new[0], new[0] + len(new)))
            assert new[0] > max(survivors, default=-1)
            for seq, old in zip(new, arrivals[chunk.offset], strict=True):
                survivors[seq] = replace(by_seq[old], seq=seq)
        self.changed = True
        if number == 0 and laid.described > cut:
            assert recording not in self.store.directory.recording_ids()
            del self.model[recording]
            return
        (entry,) = self.store.select([recording])
        known.messages = list(survivors.values())
        known.channels = {(c.topic, "Stamped" in c.type) for c in entry.channels}
        assert {(m.topic, m.has_header) for m in known.messages} <= known.channels
        known.status = "recovered"

    # What is asked.

    @rule(asked=st.lists(questions, min_size=6, max_size=10), marks=st.integers(0, 1 << 80))
    def ask(self, asked: list[Asked], marks: int) -> None:
        for question in asked:
            topics = tuple(t for i, t in enumerate(TOPICS) if marks >> i & 1)
            marks >>= len(TOPICS)
            question = replace(question, topics=topics or ("/absent",))
            check(self.store, self.model, question)
            able = replace(question, topics=with_clock(self.model, question))
            if able.topics:
                check(self.store, self.model, able)

    @invariant()
    def everything_is_there(self) -> None:
        if not self.changed:
            return
        self.changed = False
        entries = {r.id: r for r in self.store.recordings()}
        assert set(entries) == set(self.model) == set(self.store.directory.recording_ids())
        for name, known in self.model.items():
            entry = entries[name]
            assert entry.messages == len(known.messages)
            assert entry.status == known.status
            times = [m.log_time for m in known.messages]
            assert entry.span == ((min(times), max(times)) if times else None)
            assert sum(c.stats.unreadable for c in entry.channels) == sum(
                m.torn for m in known.messages
            )
        result = self.store.verify()
        assert result.findings == []
        assert result.messages == sum(len(k.messages) for k in self.model.values())
        topics = tuple(sorted({t for k in self.model.values() for t in k.topics}))
        assert tuple(self.store.topics()) == topics
        if topics:
            check(self.store, self.model, Asked(topics, None, "log", None, None, 1, reverse=False))
        for topic in topics:
            check(self.store, self.model, Asked((topic,), None, "log", None, None, 1, reverse=True))

    def chosen(self, which: int) -> str:
        return list(self.model)[which % len(self.model)]

    def open_again(self) -> None:
        self.store.close()
        self.store = hl.open(self.path, require_database=True)


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
            if k.messages
        ]
        if asked.clock == "log":
            if not any(first < end and last >= begin for first, last in spans):
                return TimeError
            everything = [m for m in everything if begin <= m.log_time < end]
        elif asked.clock == "publish":
            everything = [
                m for m in everything if m.published is not None and begin <= m.published < end
            ]
        else:
            everything = [m for m in everything if m.stamp is not None and begin <= m.stamp < end]
    if asked.number is not None:
        everything = [m for m in everything if _number(m) >= asked.number]
    everything.sort(key=lambda m: m.order, reverse=asked.reverse)
    everything = everything[:: asked.every]
    return everything if asked.limit is None else everything[: asked.limit]


def _number(message: Said) -> float:
    number = (message.fields or {}).get("number", float("-inf"))
    assert isinstance(number, int | float)
    return number


def lacks_clock(model: dict[str, Recording], asked: Asked) -> bool:
    """Whether a topic asked for has, in some recording, no such clock."""
    if asked.bounds is None or asked.clock == "log":
        return False
    return any(
        topic in asked.topics and (known.is_bag if asked.clock == "publish" else not has_header)
        for known in model.values()
        for topic, has_header in known.channels
    )


def with_clock(model: dict[str, Recording], asked: Asked) -> tuple[str, ...]:
    """The topics asked for that have the clock everywhere, and are there."""
    present = {t for k in model.values() for t in k.topics}
    able = [t for t in asked.topics if not lacks_clock(model, replace(asked, topics=(t,)))]
    return tuple(t for t in able if t in present)


def query_of(store: hl.Store, asked: Asked) -> Query:
    query = store.query(asked.topics).clock(asked.clock).every(asked.every)
    if asked.bounds is not None:
        query = query.between(*asked.bounds)
    if asked.number is not None:
        query = query.where({"number": {"$gte": asked.number}})
    if asked.limit is not None:
        query = query.limit(asked.limit)
    return query.reverse() if asked.reverse else query


def outcome(answer: Callable[[], Any]) -> Any:
    """What an answer is, or of which class its error."""
    try:
        return answer()
    except (TopicError, TimeError) as error:
        return type(error)


def check(store: hl.Store, model: dict[str, Recording], asked: Asked) -> None:
    """Ask the store and the model."""
    want = TopicError if lacks_clock(model, asked) else expected(model, asked)
    got = outcome(lambda: [seen(m) for m in query_of(store, asked)])
    if not isinstance(want, list):
        assert got is want
        assert outcome(lambda: query_of(store, asked).count()) is want
        return
    assert got == [(m.topic, m.recording, m.seq, m.log_time, m.published, m.payload) for m in want]
    assert query_of(store, asked).count() == len(want)
    if len(asked.topics) == 1:
        assert list(map(plain, query_of(store, asked).documents())) == list(map(document, want))


def seen(message: hl.Message) -> tuple[object, ...]:
    return (
        message.topic,
        message.recording,
        message.seq,
        message.log_time_ns,
        message.publish_time_ns,
        message.raw,
    )


def document(message: Said) -> dict[str, Any]:
    """The index document of a message but for its place in the segment."""
    meta: dict[str, Any] = {"t": message.log_time}
    if message.published is not None:
        meta["pub"] = message.published
    meta |= {
        "rec": message.recording,
        "topic": message.topic,
        "seq": message.seq,
        "len": len(message.payload),
        "error": message.torn,
    }
    key = struct.pack(">QIQ", *message.order)
    return {"_id": key, **(message.fields or {}), "_meta": meta}


def plain(found: dict[str, Any]) -> dict[str, Any]:
    meta = found["_meta"]
    inserted = meta.pop("inserted_at").replace(tzinfo=UTC)
    assert inserted == datetime.fromtimestamp(0, UTC) + timedelta(microseconds=meta["t"] // 1000)
    meta["len"] = meta.pop("ref")["len"]
    meta["error"] = bool(meta.pop("error", ""))
    return found


@dataclass(frozen=True)
class LaidChunk:
    """Where a chunk lies, and where the record of its arrival numbers ends."""

    offset: int
    end: int
    arrivals_end: int


@dataclass(frozen=True)
class Laid:
    """Where records lie in a segment, read record by record.

    Attributes:
        described: Where the metadata record ends that says which recording this is.
        chunks: Its chunks.
        end: Where the data section ends.
    """

    described: int
    chunks: list[LaidChunk]
    end: int

    def cut(self, spot: int, part: Literal["file", "chunk", "trailer"]) -> int:
        """A byte at which the file may end: anywhere, in a chunk, or in what follows one."""
        if part == "file" or not self.chunks:
            return self.end * spot // SPOTS
        chunk = self.chunks[spot % len(self.chunks)]
        start, end = chunk.offset, chunk.end
        if part == "trailer":
            start, end = chunk.end, chunk.arrivals_end
        return start + (end - start) * spot // SPOTS

    @classmethod
    def out(cls, content: bytes) -> Laid:
        described = 0
        chunks: list[LaidChunk] = []
        at = 8
        while True:
            opcode, length = struct.unpack_from("<BQ", content, at)
            end = at + 9 + length
            if opcode == 0x0F:
                return cls(described, chunks, at)
            if opcode == 0x0C and not described:
                described = end
            elif opcode == 0x06:
                chunks.append(LaidChunk(at, end, 0))
            elif opcode == 0x90:
                chunks[-1] = replace(chunks[-1], arrivals_end=end)
            at = end


class Index:
    """What MongoDB holds of one segment, seen past the store."""

    def __init__(
        self, database: pymongo.database.Database[dict[str, Any]], recording: str, number: int
    ) -> None:
        self._db = database
        self._recording = recording
        self._number = number
        names = database.list_collection_names()
        self._topics = [database[name] for name in names if not name.startswith("hybridlog.")]

    def arrivals(self) -> dict[int, list[int]]:
        """Arrival numbers of each chunk's messages, in the chunk's order."""
        found: dict[int, list[tuple[int, int]]] = {}
        mine = {"_meta.rec": self._recording, "_meta.ref.seg": self._number}
        for topic in self._topics:
            for each in topic.find(mine):
                ref = each["_meta"]["ref"]
                found.setdefault(ref["chunk"], []).append((ref["off"], each["_meta"]["seq"]))
        return {chunk: [seq for _, seq in sorted(part)] for chunk, part in found.items()}

    def fall_back_to(self, kept: Sequence[int], documents_only: Sequence[int]) -> None:
        """Forget all chunks of the segment but some."""
        here = {"rec": self._recording, "seg": self._number, "_id.off": {"$nin": list(kept)}}
        self._db["hybridlog.chunks"].delete_many(here)
        lost = {"$nin": [*kept, *documents_only]}
        for topic in self._topics:
            topic.delete_many(
                {
                    "_meta.rec": self._recording,
                    "_meta.ref.seg": self._number,
                    "_meta.ref.chunk": lost,
                }
            )
        self._db["hybridlog.recordings"].update_one(
            {"_id": self._recording}, {"$set": {"status": "open", "channels": [], "end": {}}}
        )


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[type[Machine]]:
    base = tmp_path_factory.mktemp("model")
    Machine.path, Machine.logs = base / "store", base
    with hl.open(Machine.path, create=True):
        # Held throughout, so that the machines need not start mongod each.
        with EmbeddedMongod(Machine.path / "mongod") as mongod:
            Machine.uri = mongod.start()
            yield Machine


def test_the_store_is_its_model(machine: type[Machine]) -> None:
    run_state_machine_as_test(
        machine,
        settings=settings(
            max_examples=9,
            stateful_step_count=20,
            deadline=None,
            phases=(Phase.generate,),
            derandomize=True,
            suppress_health_check=list(HealthCheck),
        ),
    )
