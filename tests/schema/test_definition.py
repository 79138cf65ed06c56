"""Definitions: standard ones against rosbags, spellings, and hostile ones."""

from __future__ import annotations

import contextlib
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from hybridlog.schema.definition import (
    MAX_DEFINITION,
    ArrayOf,
    Instant,
    MessageType,
    Primitive,
    Text,
    parse_definition,
    paths,
)
from hybridlog_storage.errors import DefinitionError
from hybridlog_storage.messages import Schema

RULE = "=" * 80
DUMMY = "structure_needs_at_least_one_member"


def parse(text: str, encoding: str = "ros2msg", name: str = "pkg/msg/T") -> MessageType:
    return parse_definition(Schema(name, encoding, text.encode()))


def listing(message_type: MessageType) -> dict[str, str]:
    return {p.path: p.type for p in paths(message_type)}


def assert_same_type(found, desc, table) -> None:
    """Compare a type with the description that rosbags has of it."""
    node, detail = desc
    if node in {Nodetype.ARRAY, Nodetype.SEQUENCE}:
        inner, size = detail
        assert isinstance(found, ArrayOf)
        assert found.width == (size if node == Nodetype.ARRAY else None)
        assert found.bound == (size or None if node == Nodetype.SEQUENCE else None)
        assert_same_type(found.element, inner, table)
    elif node == Nodetype.BASE:
        if detail[0] == "string":
            assert found == Text(detail[1] or None)
        else:
            assert isinstance(found, Primitive)
            assert found.name == detail[0]
    elif detail in {"builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"}:
        assert isinstance(found, Instant)
        assert found.kind == detail.rpartition("/")[2].lower()
    else:
        assert isinstance(found, MessageType)
        expected = [f for f in table[detail][1] if f[0] != DUMMY]
        assert [name for name, _ in found.fields] == [name for name, _ in expected]
        for (_, inner), (_, inner_desc) in zip(found.fields, expected, strict=True):
            assert_same_type(inner, inner_desc, table)


@pytest.mark.parametrize("ros", [1, 2])
def test_every_standard_type_of_rosbags(ros):
    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_KILTED)
    table, read = store.fielddefs, 0
    for name in table:
        # A time as a message of its own is its two numbers.
        if name in {"builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"}:
            continue
        try:
            text, _ = store.generate_msgdef(name, ros_version=ros)
            found = parse_definition(Schema(name, f"ros{ros}msg", text.encode()))
        except DefinitionError as error:
            assert "no portable wire form" in str(error) or "contains itself" in str(error)  # noqa: PT017
            continue
        assert_same_type(found, (Nodetype.NAME, name), table)
        read += 1
    assert read > 100


# --- spelling


def test_comments_constants_defaults_and_annotations_mean_nothing():
    text = (
        "\ufeff# a comment\r\n"
        "@verbatim\n"
        "uint8 A=1\n"
        "int32 B = -5 # five\n"
        'string C="# = x"\n'
        "  uint8 a 7 # default\n"
        'string b "x # y"\n'
        "float64[] c [1.0, 2.0]\n"
        "\tstring<=10[<=5]  d\n"
    )
    assert listing(parse(text)) == {
        "a": "uint8",
        "b": "string",
        "c": "float64[]",
        "d": "string<=10[<=5]",
    }


def test_ros1_words():
    text = "time t\nduration[2] d\nHeader header\nbyte b\nchar c\nstring FOO=a#b\n"
    found = parse(text, "ros1msg", "pkg/T")
    fields = dict(found.fields)
    assert fields["t"] == Instant("time", False, False)
    assert fields["d"] == ArrayOf(Instant("duration", True, True), 2)
    assert [name for name, _ in fields["header"].fields] == ["seq", "stamp", "frame_id"]
    assert fields["b"].code == "i1"
    assert fields["c"].code == "u1"


def test_ros2_words():
    text = "builtin_interfaces/Time t\nbuiltin_interfaces/msg/Duration d\nbyte b\nchar c\n"
    fields = dict(parse(text).fields)
    assert fields["t"] == Instant("time", True, False)
    assert fields["d"] == Instant("duration", True, False)
    assert fields["b"].code == "u1"
    assert fields["c"].code == "u1"
    assert [n for n, _ in dict(parse("std_msgs/Header h\n").fields)["h"].fields] == [
        "stamp",
        "frame_id",
    ]


def test_a_definition_that_is_there_counts():
    text = f"std_msgs/Header h\n{RULE}\nMSG: std_msgs/Header\nuint8 mine\n"
    for encoding in ("ros1msg", "ros2msg"):
        assert listing(parse(text, encoding))["h.mine"] == "uint8"
    text = f"builtin_interfaces/Time t\n{RULE}\nMSG: builtin_interfaces/Time\nint64 ticks\n"
    assert listing(parse(text)) == {"t": "builtin_interfaces/Time", "t.ticks": "int64"}
    text = (
        f"builtin_interfaces/Time t\n{RULE}\n"
        "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    )
    assert listing(parse(text)) == {"t": "time"}


def test_names_without_a_package():
    text = f"\n{RULE}\n".join(
        [
            "Inner a\nother/Deep b\nLone c",
            "MSG: pkg/Inner\nuint8 x",
            "MSG: other/Deep\nInner y",
            "MSG: other/Inner\nuint16 z",
            "MSG: far/Lone\nbool w\n",
        ]
    )
    assert listing(parse(text, "ros1msg", "pkg/T")) == {
        "a": "pkg/Inner",
        "a.x": "uint8",
        "b": "other/Deep",
        "b.y": "other/Inner",
        "b.y.z": "uint16",
        "c": "far/Lone",
        "c.w": "bool",
    }
    assert listing(parse("uint8 x\n", "ros1msg", "foo")) == {"x": "uint8"}


def test_an_empty_text_is_a_message_without_fields():
    assert parse("", "ros1msg").fields == ()
    assert parse("# nothing\n").fields == ()
    assert parse(f"uint8 {DUMMY}\n").fields == ()


def test_paths_tell_arrays():
    text = f"Inner[] a\nuint8[3] b\nInner c\n{RULE}\nMSG: pkg/Inner\nfloat64[9] x\nstring s\n"
    assert [(p.path, p.type, p.array) for p in paths(parse(text))] == [
        ("a", "pkg/Inner[]", True),
        ("a[].x", "float64[9]", True),
        ("a[].s", "string", True),
        ("b", "uint8[3]", True),
        ("c", "pkg/Inner", False),
        ("c.x", "float64[9]", True),
        ("c.s", "string", False),
    ]


# --- IDL

IDL = """
// generated from rosidl_adapter/resource/msg.idl.em
#include "std_msgs/msg/Header.idl"
module pkg {
  module msg {
    typedef double double__9[9];
    typedef pkg::msg::Inner Inner__2[2];
    module T_Constants {
      const uint8 LIMIT = 4;
      @verbatim (language="comment", text= "says ) \\" nothing" "more")
      const string NAME = "a;b";
    };
    enum Mode { ONE, @value(7) TWO };
    @verbatim (language="comment", text="a comment")
    struct T {
      std_msgs::msg::Header header;
      builtin_interfaces::msg::Time stamp;
      /* block
         comment */
      boolean a; octet b; char c;
      @unit (value="m") @default (value=1.5)
      double d;
      float e, f[3];
      long long g; unsigned long long h; unsigned long i; short j; unsigned short k; long l;
      int8 m; uint8 n;
      string o; string<5> p;
      double__9 q;
      sequence<double> r;
      sequence<pkg::msg::Inner, T_Constants::LIMIT> s;
      Inner__2 t;
      Mode u;
      sequence<string<3>> v;
    };
  };
};
"""
INNER_IDL = "module pkg { module msg { struct Inner { long x; }; }; };"
IDL_FIELDS = {
    "header": "std_msgs/Header",
    "header.stamp": "time",
    "header.frame_id": "string",
    "stamp": "time",
    "a": "bool",
    "b": "byte",
    "c": "char",
    "d": "float64",
    "e": "float32",
    "f": "float32[3]",
    "g": "int64",
    "h": "uint64",
    "i": "uint32",
    "j": "int16",
    "k": "uint16",
    "l": "int32",
    "m": "int8",
    "n": "uint8",
    "o": "string",
    "p": "string<=5",
    "q": "float64[9]",
    "r": "float64[]",
    "s": "pkg/Inner[<=4]",
    "s[].x": "int32",
    "t": "pkg/Inner[2]",
    "t[].x": "int32",
    "u": "uint32",
    "v": "string<=3[]",
}


def test_idl():
    text = f"{RULE}\nIDL: pkg/msg/T\n{IDL}\n{RULE}\nIDL: pkg/msg/Inner\n{INNER_IDL}\n"
    assert listing(parse(text, "ros2idl")) == IDL_FIELDS
    assert listing(parse(IDL + INNER_IDL, "ros2idl")) == IDL_FIELDS


def test_msg_and_idl_may_be_mixed():
    text = f"pkg/Inner a\n{RULE}\nIDL: pkg/msg/Inner\n{INNER_IDL}\n"
    assert listing(parse(text)) == {"a": "pkg/Inner", "a.x": "int32"}


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ("struct T { @optional long x; };", "optional"),
        ("struct T { wstring x; }; }; };", "wstring has no portable wire form"),
        ("struct T { long double x; }; }; };", "float128 has no portable wire form"),
        ("struct T { map<long, long> x; };", "'map < long , long > x' has no ROS wire form"),
        ("union T switch (long) { case 1: long x; };", "'union' has no ROS wire form"),
        ("struct T : Other { long x; };", "inherits"),
        ("struct T { long x[2][3]; };", "array of arrays"),
        ("struct T { sequence<sequence<long>> x; };", "has no ROS wire form"),
        ("typedef long a[2]; struct T { sequence<a> x; }; }; };", "array of arrays"),
        ("typedef a b; typedef b a; struct T { a x; }; }; };", "circle"),
        ("struct T { long x[N]; };", "must be a number or a constant, found 'N'"),
        ("struct T { long x[]; };", "must be a number or a constant"),
        ("struct T { long x[2 * 3]; };", "must be a number or a constant, found '2 * 3'"),
        ("struct T { long x[-1]; };", "must be a number or a constant"),
        ("struct T { long x[1.5]; };", "must be a number or a constant"),
        ("const long N = 1 << 4; struct T { long x[N]; };", "found 'N'"),
        ("struct B; struct T { B x; }; }; };", "does not say what"),
        ("struct T { long x", "ends too early"),
        ("struct T { Other x; }; }; };", "does not say what"),
        ("struct T { long x; }; struct T { long y; };", "defined twice"),
        ("module " * 30 + "struct T { long x; };", "'module' has no ROS wire form"),
        ("module a { " * 30, "nested too deep"),
        ("@(", "ends too early"),
        ("struct T { sequence<T> x; }; }; };", "contains itself"),
        ("\x00;", "has no ROS wire form"),
    ],
)
def test_idl_that_is_refused(body, reason):
    with pytest.raises(DefinitionError, match="pkg/") as caught:
        parse(f"module pkg {{ module msg {{ {body}", "ros2idl")
    assert reason in str(caught.value)


@pytest.mark.parametrize(("size", "value"), [("0x1F", 31), ("017", 15), ("MOST", 3)])
def test_sizes_of_idl(size, value):
    text = f"""module pkg {{ module msg {{
      const long MOST = 3; const double HALF = 0.5 * 2; const string S = "a;b]";
      const long N = {size};
      struct T {{ long a[{size}]; sequence<long, {size}> b; string<N> c; long d[N]; }};
    }}; }};"""
    expected = {
        "a": f"int32[{value}]",
        "b": f"int32[<={value}]",
        "c": f"string<={value}",
        "d": f"int32[{value}]",
    }
    assert listing(parse(text, "ros2idl")) == expected


def test_forward_declarations_and_other_idl():
    text = "module a { struct B; struct T { B b; }; struct B { long x; }; };"
    for encoding in ("ros2idl", "omgidl"):
        found = parse(f"#pragma once\n{text}", encoding, "a::T")
        assert listing(found) == {"b": "a/B", "b.x": "int32"}


# --- lines and separators


@pytest.mark.parametrize("odd", ["\f", "\v", "\r", "\x1c", "\x85", "\u2028", "\u2029", "\0"])
@pytest.mark.parametrize("encoding", ["ros1msg", "ros2msg"])
def test_only_a_newline_ends_a_comment(odd, encoding):
    text = f"# as {odd}uint8 T\nuint8 A=1 # {odd}uint8 b\nfloat64 x # {odd}rac\nfloat64 y{odd}\n"
    if odd == "\0":
        text = text.replace("y\0", "y")
    found = listing(parse(text, encoding, "pkg/T"))
    assert found == {"x": "float64", "y": "float64"}
    table = get_types_from_msg(text.replace(f"y{odd}", "y"), "pkg/msg/T")
    assert [name for name, _ in table["pkg/msg/T"][1]] == ["x", "y"]


def test_line_ends_of_other_systems():
    for encoding in ("ros1msg", "ros2msg"):
        assert listing(parse("uint8 a\r\n# b\r\nuint8 c\r\n", encoding)) == {
            "a": "uint8",
            "c": "uint8",
        }
    assert listing(parse("uint8 a\r# b\ruint8 c")) == {"a": "uint8", "c": "uint8"}
    with pytest.raises(DefinitionError, match="line 1"):
        parse("uint8 a\r# b\ruint8 c", "ros1msg")


@pytest.mark.parametrize("before", ["\n", "", " ", " # a comment", "\n# ="])
@pytest.mark.parametrize("after", ["\n", "", "  \r\n"])
@pytest.mark.parametrize("encoding", ["ros1msg", "ros2msg"])
def test_missing_newlines_around_separators(before, after, encoding):
    text = (
        f"pkg/Sub sub{before}{RULE}{after}MSG: pkg/Sub\n"
        f"float64 x{before}{RULE}{after}MSG: other/Lone\nuint8 y"
    )
    assert listing(parse(text, encoding)) == {"sub": "pkg/Sub", "sub.x": "float64"}


def test_rules_in_comments_and_constants_separate_nothing():
    text = f"# {RULE}\nstring A={RULE}\nuint8 x\n# {RULE}\n# MSG: pkg/T\nuint8 y # {RULE} z\n"
    for encoding in ("ros1msg", "ros2msg"):
        assert listing(parse(text, encoding)) == {"x": "uint8", "y": "uint8"}


def test_arrays_without_elements():
    text = f"uint8[0] a\nSub[0] b\n{RULE}\nMSG: pkg/Sub\nstring[0] c\n"
    expected = {"a": "uint8[0]", "b": "pkg/Sub[0]", "b[].c": "string[0]"}
    assert listing(parse(text, "ros1msg")) == expected
    with pytest.raises(DefinitionError, match="from 1 to"):
        parse(text)


# --- hostile and broken definitions


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("uint8\n", "line 1 is not a field"),
        ("\nuint8 a\n??\n", "line 3 is not a field"),
        ("uint8 a.b\n", "line 1 is not a field"),
        ("uint8 a; import os\n", "line 1 is not a field"),
        ("uint8 a\nuint8 a\n", "two fields named a"),
        ("uint8 9a\n", "cannot be named '9a'"),
        ("uint8 _a\n", "cannot be named '_a'"),
        (f"uint8 {'a' * 300}\n", "cannot be named"),
        ("nobody/Knows a\n", "does not say what nobody/Knows is"),
        ("Nobody a\n", "does not say what pkg/Nobody is"),
        ("pkg/T a\n", "pkg/T contains itself"),
        (f"A a\n{RULE}\nMSG: pkg/A\nB[] b\n{RULE}\nMSG: pkg/B\nA[] a\n", "pkg/A contains itself"),
        ("wstring a\n", "not indexed: wstring has no portable wire form"),
        ("wstring<=4 a\n", "not indexed: wstring has no portable wire form"),
        ("float128[] a\n", "not indexed: float128 has no portable wire form"),
        ("uint8[4294967295] a\n", "4294967295 elements"),
        ("uint8[0] a\n", "0 elements"),
        ("uint8[<=] a\n", "bound without a number"),
        ("uint8<=3 a\n", "only strings have a length bound"),
        (f"uint8 a\n{RULE}\nMSG: pkg/A\nbool b\n{RULE}\nMSG: pkg/A\nbool c\n", "defined twice"),
        ("uint8 a\n---\n---\n---\n", "4 parts"),
    ],
)
def test_definitions_that_are_refused(text, reason):
    with pytest.raises(DefinitionError) as caught:
        parse(text)
    assert "pkg/" in str(caught.value)
    assert reason in str(caught.value)


def test_no_definition_and_foreign_encodings():
    with pytest.raises(DefinitionError, match="not a ROS definition"):
        parse("{}", "jsonschema")
    with pytest.raises(DefinitionError, match="more than"):
        parse("#" * (MAX_DEFINITION + 1))


def chain(length: int, line: str) -> str:
    parts = [line.format(1)]
    parts += [f"{RULE}\nMSG: pkg/A{k}\n{line.format(k + 1)}" for k in range(1, length)]
    return "\n".join([*parts, f"{RULE}\nMSG: pkg/A{length}\nuint8 x\n"])


def test_nesting_and_unfolding_are_bounded():
    assert len(paths(parse(chain(60, "A{0} a")))) == 61
    assert len(paths(parse(chain(28, "A{0}[] a")))) == 29
    for text, reason in [
        (chain(80, "A{0} a"), "nested deeper"),
        (chain(40, "A{0}[] a"), "nested deeper"),  # an array is two levels of a column
        (chain(5000, "A{0} a"), "nested deeper"),
        (chain(40, "A{0} a\nA{0} b"), "unfolds to"),
        (chain(10, "A{0}[200000000] a"), "bytes at the least"),
    ]:
        with pytest.raises(DefinitionError, match=reason):
            parse(text)


@pytest.mark.parametrize(
    ("encoding", "piece"),
    [
        ("ros2msg", "uint8 a\n"),
        ("ros2msg", "a/"),
        ("ros2msg", f"{RULE}\nMSG: a/B\n"),
        ("ros2msg", "---\n"),
        ("ros2msg", "\n"),
        ("ros2msg", " \t"),
        ("ros2msg", "---\n|\n"),
        ("ros2msg", "---\n|bool A=1\n"),
        ("ros2msg", "[<="),
        ("ros2idl", "/*"),
        ("ros2idl", '"\\'),
        ("ros2idl", '\\"'),
        ("ros2idl", "((("),
        ("ros2idl", "@a"),
        ("ros2idl", "::a"),
        ("ros2idl", "module a {"),
        ("ros2idl", "const long a = 1 << 1;"),
        ("ros2idl", "typedef long a;"),
        ("ros2idl", "sequence<"),
    ],
)
def test_the_largest_definitions_are_refused_or_read_in_time(encoding, piece):
    prefix, _, piece = piece.rpartition("|")
    text = prefix + (piece * (MAX_DEFINITION // len(piece)))[: MAX_DEFINITION - len(prefix)]
    started = time.thread_time()  # the machine may be busy
    try:
        parse(text, encoding)
    except DefinitionError as error:
        assert len(str(error)) < 1000  # noqa: PT017
    assert time.thread_time() - started < 20


TOKENS = st.sampled_from(
    [
        *("uint8", "string", "time", "a", "b", "pkg/T", "T", "[", "]", "<=", "3", "=", "#", "---"),
        *("\n", "\n", " ", " ", RULE, "MSG: pkg/A", "IDL: pkg/msg/A", "@", "\x00", "ü", "\\"),
        *("module", "struct", "{", "}", ";", "typedef", "const", "enum", "sequence", "<", ">"),
        *(",", "::", "pkg", "msg", "long", "unsigned", "(", ")", '"', "'", "/*", "//", "0x1"),
    ]
)


@given(
    st.lists(TOKENS, max_size=40),
    st.sampled_from(["", " "]),
    st.sampled_from(["ros1msg", "ros2msg", "ros2idl"]),
)
def test_nothing_but_one_error_comes_of_garbage(tokens, glue, encoding):
    try:
        found = parse(glue.join(tokens), encoding)
    except DefinitionError:
        return
    assert isinstance(found, MessageType)
    paths(found)


@given(st.binary(max_size=200), st.sampled_from(["ros1msg", "ros2msg", "ros2idl"]))
def test_bytes_that_are_no_text(data, encoding):
    with contextlib.suppress(DefinitionError):
        parse_definition(Schema("pkg/T", encoding, data))


ADD = "int64 a\nint64 b\n---\nint64 sum\n"
IDL_ADD = (
    "module p { module srv {\nstruct A_Request { long long a; long long b; };\n"
    "struct A_Response { long long sum; };\n}; };\n"
)


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        (f"{RULE}\nSRV: p/srv/A\n{ADD}", "ros2msg"),
        (f"\n\n{RULE}\nSRV: p/srv/A\n{ADD}", "ros2msg"),
        (f"# recorded\n\n{RULE}\nSRV: p/srv/A\n\n{ADD}\n{RULE}\nMSG: p/msg/B\nint8 c\n", "ros2msg"),
        (f"{RULE}SRV: p/srv/A\n{ADD}", "ros2msg"),
        (f"{RULE}\r\nSRV: p/srv/A\r\n{ADD}".replace("\n", "\r\n"), "ros2msg"),
        (ADD, "ros2msg"),
        (f"{RULE}\nIDL: p/srv/A\n{IDL_ADD}", "ros2msg"),
        (IDL_ADD, "ros2idl"),
    ],
)
def test_events_of_a_service_in_all_spellings(text, encoding):
    found = listing(parse(text, encoding, "p/srv/A_Event"))
    assert found["info.event_type"] == "uint8"
    assert found["request"] == "p/srv/A_Request[<=1]"
    assert (found["request[].b"], found["response[].sum"]) == ("int64", "int64")


def test_a_message_without_fields_before_others():
    assert parse(f"\n{RULE}\nMSG: p/Other\nint8 x\n", name="p/Nothing").fields == ()
    assert parse(f"# only words\n{RULE}\nMSG: p/Other\nint8 x\n", name="p/Nothing").fields == ()
