"""Values of messages in every output, against what other readers say of the same files."""

from __future__ import annotations

import base64
import csv
import io
import json
import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from mcap.reader import make_reader

import hybridlog as hl
from hybridlog_storage.errors import TopicError
from hybridlog_storage.messages import Channel, Schema
from tests.every_output import parquet, written

CASES = Path(__file__).parent / "cases"
LOGS = [
    "json_int64_missing.mcap",
    "json_optional_keys.mcap",
    "uint64_extremes.mcap",
    "foxglove_protobuf.mcap",
    "clouds_mixed_empty.mcap",
    "z_dup_stamp.bag",
]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    with hl.open(tmp_path_factory.mktemp("values") / "store", create=True) as opened:
        for name in LOGS:
            opened.record(CASES / name)
        # A second recording of one of the topics.
        opened.record(CASES / "json_optional_keys.mcap", name="again", again=True)
        with opened.start("made") as made:
            record_made(made)
        yield opened


def record_made(recorder: Any) -> None:
    """Two topics whose fields are called as columns of ours are."""
    text = b"Header header\nuint32 seq\nstring recording\nfloat64 log_time\nint64[] many\n" + (
        b"=" * 80 + b"\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
    )
    channel = Channel("/own", "ros1", Schema("p/Own", "ros1msg", text), {}, True)
    plain = Channel("/plain", "ros1", Schema("p/Plain", "ros1msg", b"float32[] r\nstring s"))
    for n in range(10):
        many = struct.pack(f"<I{n}q", n, *((1 << 62) + k for k in range(n)))
        payload = struct.pack("<III", n, 7, 8 + n) + struct.pack("<I", 1) + b"f"
        payload += struct.pack("<I", 100 + n) + struct.pack("<I", 2) + b"re"
        payload += struct.pack("<d", 0.5) + many
        recorder.write(channel, payload, log_time=1000 + n, publish_time=500 + n, sequence=40 + n)
        floats = struct.pack("<I3f", 3, n, math.inf, math.nan)
        recorder.write(plain, floats + struct.pack("<I", 0), log_time=1000 + n)


def payloads(name: str, topic: str) -> list[bytes]:
    with (CASES / name).open("rb") as file:
        return [m.data for _, c, m in make_reader(file).iter_messages(topics=[topic])]


def json_lines(query: Any) -> list[dict[str, Any]]:
    lines = written(query, "jsonl").decode().splitlines()
    return [json.loads(line, parse_constant=pytest.fail) for line in lines]


def csv_rows(query: Any) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(written(query, "csv").decode(), newline="")))


def flat(value: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, inner in value.items():
        if isinstance(inner, dict) and inner:
            found |= flat(inner, f"{prefix}{name}.")
        else:
            found[prefix + name] = inner
    return found


# --- JSON -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("log", "topic"),
    [
        *(("json_int64_missing.mcap", topic) for topic in ("/j", "/k", "/a")),
        *(("json_optional_keys.mcap", topic) for topic in ("/opt", "/ints", "/ints2", "/mix")),
    ],
)
def test_json_lines_are_the_messages(store: hl.Store, log: str, topic: str) -> None:
    query = store.topic(topic).in_recording(log.split(".", maxsplit=1)[0])
    rows = json_lines(query)
    wanted = [flat(json.loads(payload)) for payload in payloads(log, topic)]
    for row, want in zip(rows, wanted, strict=True):
        assert row.pop("topic") == topic
        del row["log_time_ns"]
        assert row == want  # the same fields, no more: missing is absent, null is null
        assert list(map(type, row.values())) == list(map(type, want.values()))


def test_json_integers_are_exact_in_every_output(store: hl.Store) -> None:
    query = store.topic("/j")
    wanted = [1700000000123456789, None, 1700000000123456790]
    ids = [9007199254740993, None, None]
    for table in (query.to_arrow(), parquet(query)):
        assert table["t_ns"].type == pa.int64()
        assert table["t_ns"].to_pylist() == wanted
        assert table["id"].to_pylist() == ids
    frame = query.to_pandas()
    assert str(frame["t_ns"].dtype) == "Int64"
    assert [None if v is pd.NA else v for v in frame["t_ns"]] == wanted
    assert [row["id"] for row in csv_rows(query)] == ["9007199254740993", "", ""]
    arrays = np.load(io.BytesIO(written(query, "npz")))
    assert arrays["id"][0] == ids[0]
    assert arrays["id.valid"].tolist() == [True, False, False]


def test_odd_values_stay_apart(tmp_path: Path) -> None:
    texts = [
        b'{"f": NaN, "s": "", "l": [], "b": false, "i": 0}',
        b'{"f": null, "s": null, "l": null, "b": null, "i": null}',
        b"{}",
        b'{"f": 1.5, "s": "x", "l": [null], "b": true, "i": 1, "m": {}}',
    ]
    with hl.open(tmp_path / "store", create=True) as store:
        with store.start("x") as recorder:
            for n, text in enumerate(texts):
                recorder.write(Channel("/o", "json", None), text, log_time=1 + n)
        query = store.topic("/o")
        rows = json_lines(query)
        for row in rows:
            del row["log_time_ns"], row["topic"]
        assert rows[0] == {"f": "NaN", "s": "", "l": [], "b": False, "i": 0}
        assert rows[1] == dict.fromkeys("fslbi")
        assert rows[2] == {}
        assert rows[3] == {"f": 1.5, "s": "x", "l": [None], "b": True, "i": 1, "m": {}}
        for table in (query.to_arrow(), parquet(query)):
            for name in "fslbi":
                assert table[name].is_null().to_pylist() == [False, True, True, False]
            assert math.isnan(table["f"][0].as_py())
            assert table["s"][0].as_py() == ""
            assert table["l"].to_pylist() == [[], None, None, [None]]
        frame = query.to_pandas()
        assert frame["f"].dtype == "Float64"
        assert frame["f"].isna().tolist() == [False, True, True, False]
        assert math.isnan(frame["f"].iloc[0])
        assert frame["s"].iloc[0] == ""
        assert (frame["b"].dtype, frame["b"].iloc[0]) == ("boolean", np.False_)
        text = written(query.fields("f", "s", "l", "b", "i"), "csv").decode().splitlines()
        cells = [line.split(",", 1)[1] for line in text]
        assert cells == [
            '"f","s","l","b","i"',
            'nan,"","[]",false,0',
            ",,,,",
            ",,,,",
            '1.5,"x","[null]",true,1',
        ]


# --- ROS --------------------------------------------------------------------------------


def test_unsigned_extremes(store: hl.Store) -> None:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_typestore(Stores.ROS2_HUMBLE)
    with (CASES / "uint64_extremes.mcap").open("rb") as file:
        ((schema, _, first), *others) = list(make_reader(file).iter_messages())
    types.register(get_types_from_msg(schema.data.decode(), schema.name))
    raw = [first.data, *(message.data for _, _, message in others)]
    messages: list[Any] = [types.deserialize_cdr(data, schema.name) for data in raw]
    wanted = [int(message.big) for message in messages]
    query = store.topic("/zoo")
    for chosen in (query, query.fields("big"), query.fields("big", "bigs")):
        assert chosen.to_pandas()["big"].tolist() == wanted
        assert chosen.to_arrow()["big"].to_pylist() == wanted
        assert parquet(chosen)["big"].to_pylist() == wanted
        assert [int(row["big"]) for row in csv_rows(chosen)] == wanted
        assert [row["big"] for row in json_lines(chosen)] == wanted
    arrays = [[int(v) for v in message.bigs] for message in messages]
    assert query.to_arrow()["bigs"].to_pylist() == arrays
    assert [cell.tolist() for cell in query.to_pandas()["bigs"]] == arrays
    assert [row["bigs"] for row in json_lines(query)] == arrays
    summary = query.fields("bigs.max", "arr.min", "arr.n", "bigs").to_pandas()
    assert summary["bigs.max"].tolist() == [max(cell) for cell in arrays]
    assert summary["arr.n"].tolist() == [len(message.arr) for message in messages]


# --- protobuf ---------------------------------------------------------------------------


def test_protobuf_is_whole_in_every_output(store: hl.Store) -> None:
    from mcap_protobuf.decoder import DecoderFactory

    with (CASES / "foxglove_protobuf.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        clouds = [d.decoded_message for d in reader.iter_decoded_messages(topics=["/pc"])]
    query = store.topic("/pc")
    data = [cloud.data for cloud in clouds]
    fields = [[(f.name, f.offset, f.type) for f in cloud.fields] for cloud in clouds]
    for table in (query.to_arrow(), parquet(query)):
        assert table["data"].type == pa.binary()
        assert table["data"].to_pylist() == data
        assert table["point_stride"].type == pa.uint32()
        assert [[tuple(f.values()) for f in row] for row in table["fields"].to_pylist()] == fields
    frame = query.to_pandas()
    assert frame["data"].tolist() == data
    assert [[tuple(f.values()) for f in row] for row in frame["fields"]] == fields
    encoded = [base64.b64encode(value).decode() for value in data]
    assert [row["data"] for row in csv_rows(query)] == encoded
    rows = json_lines(query)
    assert [row["data"] for row in rows] == encoded
    assert [[tuple(f.values()) for f in row["fields"]] for row in rows] == fields
    assert rows[0]["timestamp"] == clouds[0].timestamp.ToNanoseconds()
    sizes = query.fields("data.n", "fields.n", "frame_id")
    assert sizes.to_pandas()["data.n"].tolist() == [len(value) for value in data]
    assert [row["data.n"] for row in json_lines(sizes)] == [len(value) for value in data]
    assert "data" not in json_lines(sizes)[0]
    assert sizes.to_arrow()["fields.n"].to_pylist() == [len(row) for row in fields]


# --- names ------------------------------------------------------------------------------


def test_columns_of_ours(store: hl.Store) -> None:
    query = store.topic("/own").fields("publish_time", "stamp", "sequence", "recording", "many.n")
    table = query.to_arrow()
    assert table.column_names == [
        *("log_time", "publish_time", "stamp", "sequence", "recording", "recording_", "many.n")
    ]
    assert table["publish_time"].cast(pa.int64()).to_pylist() == [500 + n for n in range(10)]
    assert table["stamp"].cast(pa.int64()).to_pylist() == [7 * 10**9 + 8 + n for n in range(10)]
    assert table["sequence"].to_pylist() == [40 + n for n in range(10)]
    assert table["recording"].to_pylist() == ["made"] * 10
    assert table["recording_"].to_pylist() == ["re"] * 10
    assert list(query.to_pandas().columns) == table.column_names[1:]
    rows = json_lines(query)
    assert rows[3]["publish_time"] == 503
    assert rows[3]["stamp"] == 7 * 10**9 + 11
    assert rows[3]["recording"] == "made"
    assert rows[3]["recording_"] == "re"
    assert [row["sequence"] for row in csv_rows(query)] == [str(40 + n) for n in range(10)]
    # A field of the topic is meant where there is one.
    assert store.topic("/own").fields("seq").to_arrow()["seq"].to_pylist() == [
        100 + n for n in range(10)
    ]
    whole = store.topic("/own").to_arrow()
    assert whole["log_time"].cast(pa.int64()).to_pylist() == [1000 + n for n in range(10)]
    assert whole["log_time_"].to_pylist() == [0.5] * 10
    plain = store.topic("/plain").fields("seq", "stamp", "s").to_arrow()
    assert plain["seq"].to_pylist() == sorted(plain["seq"].to_pylist())
    assert plain["stamp"].null_count == 10
    bag = store.topic("/d").in_recording("z_dup_stamp").fields("publish_time").to_arrow()
    assert bag["publish_time"].null_count == bag.num_rows
    with pytest.raises(TopicError, match="arrival"):
        store.topic("/plain").fields("arrival")


# --- other libraries --------------------------------------------------------------------


def test_values_of_several_types_are_json_text(store: hl.Store) -> None:
    query = store.topic("/mix").in_recording("json_optional_keys")
    wanted = [json.loads(payload)["v"] for payload in payloads("json_optional_keys.mcap", "/mix")]
    for table in (query.to_arrow(), parquet(query)):
        assert [json.loads(text) for text in table["v"].to_pylist()] == wanted
    assert [json.loads(text) for text in query.to_pandas()["v"]] == wanted
    assert [json.loads(row["v"]) for row in csv_rows(query)] == wanted
    assert query.to_arrow().schema.field("v").type == pa.json_()
