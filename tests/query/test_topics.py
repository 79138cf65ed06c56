from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridlog.query.topics import matcher, resolve
from hybridlog_storage.errors import TopicError
from tests.work import calls_in

TOPICS = [
    "/base/scan",
    "/camera/image_raw",
    "/front/camera/camera_info",
    "/front/camera/image_raw",
    "/imu/data",
    "/left_scan",
    "/odom",
    "/right_scan",
    "/tf",
    "/tf_static",
    "/Weird",
    "AAA",
    "/a[0]",
]


@pytest.mark.parametrize(
    ("pattern", "found"),
    [
        ("/base/scan", ["/base/scan"]),
        ("scan", ["/base/scan"]),
        ("base/scan", ["/base/scan"]),
        ("front/camera/image_raw", ["/front/camera/image_raw"]),
        ("tf", ["/tf"]),
        ("weird", ["/Weird"]),
        ("/IMU/Data", ["/imu/data"]),
        ("aaa", ["AAA"]),
        ("/a[0]", ["/a[0]"]),
        ("*_scan", ["/left_scan", "/right_scan"]),
        ("/*_scan", ["/left_scan", "/right_scan"]),
        ("*scan", ["/base/scan", "/left_scan", "/right_scan"]),
        ("/*scan", ["/left_scan", "/right_scan"]),
        ("/**scan", ["/base/scan", "/left_scan", "/right_scan"]),
        ("camera/*", ["/camera/image_raw", "/front/camera/camera_info", "/front/camera/image_raw"]),
        ("/*/scan", ["/base/scan"]),
        ("/front/**", ["/front/camera/camera_info", "/front/camera/image_raw"]),
        ("t?", ["/tf"]),
        ("[lr]*_scan", ["/left_scan", "/right_scan"]),
        ("[!a-m]*_scan", ["/right_scan"]),
        ("re:/(left|right)_scan", ["/left_scan", "/right_scan"]),
        ("re:.*scan", ["/base/scan", "/left_scan", "/right_scan"]),
        ("**", sorted(TOPICS)),
        ("*", sorted(TOPICS)),
    ],
)
def test_resolve(pattern: str, found: list[str]) -> None:
    assert resolve([pattern], TOPICS) == found


def test_order_and_once() -> None:
    assert resolve(["tf", "*_scan", "left_scan"], TOPICS) == ["/tf", "/left_scan", "/right_scan"]
    assert resolve([], TOPICS) == []


@pytest.mark.parametrize(
    ("pattern", "message"),
    [
        ("image", "did you mean.*/camera/image_raw"),
        ("/scan", "did you mean /base/scan"),
        ("scna", "did you mean /base/scan"),
        ("odometry", "/odom"),
        ("xyzzy", "there are"),
        ("*nothing*", "no topic matches"),
        ("re:(", "is refused: missing"),
        ("re:(?=a)b", "is refused: invalid perl operator"),
        (r"re:(a)\1", "refused: .*back references"),
        ("re:" + "a" * 201, "longer than 200"),
        ("", "1 to 1000"),
        ("x" * 2000, "1 to 1000"),
        ("[ab", "not closed"),
    ],
)
def test_refused(pattern: str, message: str) -> None:
    with pytest.raises(TopicError, match=message):
        resolve([pattern], TOPICS)


def test_ambiguous() -> None:
    with pytest.raises(TopicError, match=r"ambiguous.*/base/scan, /top/scan"):
        resolve(["scan"], ["/base/scan", "/top/scan"])
    with pytest.raises(TopicError, match="ambiguous"):
        resolve(["SCAN"], ["/a/scan", "/a/Scan"])
    with pytest.raises(TopicError, match=r"ambiguous.*write more of the name"):
        resolve(["scan"], ["/base/scan", "/scan"])
    assert resolve(["/scan"], ["/base/scan", "/scan"]) == ["/scan"]
    assert resolve(["scan"], ["/scan", "scan"]) == ["scan"]
    assert resolve(["Scan"], ["/a/scan", "/a/Scan"]) == ["/a/Scan"]


def test_at_most_ten_candidates() -> None:
    many = [f"/robot{i}/scan" for i in range(50)]
    with pytest.raises(TopicError, match="and 40 more") as caught:
        resolve(["scan"], many)
    assert str(caught.value).count("/scan") == 10


def test_no_topics_and_control_characters() -> None:
    with pytest.raises(TopicError, match="there are none"):
        resolve(["scan"], [])
    with pytest.raises(TopicError) as caught:
        resolve(["scan"], ["/evil\x1b[2J/scan", "/b/scan"])
    assert "\x1b" not in str(caught.value)


@pytest.mark.parametrize(
    ("pattern", "topic"),
    [("*a" * 300 + "b", "/" + "a" * 500), ("**a" * 100 + "b", "/" + "a/" * 250)],
)
def test_globs_do_not_run_away(pattern: str, topic: str) -> None:
    fits = matcher([pattern])
    assert not fits(topic)
    assert calls_in(lambda: fits(topic)) < 10 * len(pattern) * len(topic)


def test_matcher() -> None:
    wanted = matcher(["scan", "camera/*", "/gone"], ["*info", "nowhere"])
    seen = [topic for topic in TOPICS if wanted(topic)]
    assert seen == ["/base/scan", "/camera/image_raw", "/front/camera/image_raw"]
    assert wanted.unused() == ["/gone", "nowhere"]
    everything = matcher()
    assert everything("/x")
    assert everything.unused() == []
    assert not matcher([], ["/x"])("/x")
    with pytest.raises(TopicError):
        matcher(["re:("])


part = st.text(alphabet="ab_", min_size=1, max_size=4)
name = st.lists(part, min_size=1, max_size=4).map(lambda parts: "/" + "/".join(parts))
glob = st.lists(st.sampled_from(["a", "b", "/", "*", "**", "?", "[ab]", "[!a]"]), max_size=7).map(
    "".join
)


@given(glob.filter(lambda text: any(c in text for c in "*?[") and "***" not in text), name)
def test_globs_equal_their_regular_expression(pattern: str, topic: str) -> None:
    table = {"*": "[^/]*", "**": ".*", "?": "[^/]", "[ab]": "[ab]", "[!a]": "[^a/]"}
    tokens = re.findall(r"\*\*|\[.*?\]|.", pattern)
    body = "".join(table.get(token, re.escape(token)) for token in tokens)
    prefix = "" if pattern.startswith("/") else "(?:.*/)?"
    expected = re.fullmatch(prefix + body, topic) is not None
    if not pattern.startswith("/") and not expected:
        expected = re.fullmatch(body, topic) is not None
    # An empty run at the end of a name is no run of whole parts; names never end in "/".
    assert matcher([pattern])(topic) == expected


@given(name, st.lists(name, max_size=5))
def test_a_full_name_is_itself(topic: str, others: list[str]) -> None:
    assert resolve([topic], [*others, topic]) == [topic]
