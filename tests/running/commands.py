"""Every command about a recording that goes on, with what is right, in plain Python."""

from __future__ import annotations

import csv
import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow.parquet as pq
from mcap.reader import make_reader
from PIL import Image
from rosbags.rosbag1 import Reader as BagReader

from tests.cli.within import Answer
from tests.running.methods import (
    LABEL,
    beside,
    between_messages,
    changed,
    held,
    in_force,
    numbers,
    ranged,
    regular,
    silent,
)
from tests.running.sequence import MS, SECOND, Known


class Asked(NamedTuple):
    """A command, and the right answer.

    Attributes:
        words: The command; `OUT` is a path for its output.
        read: Reads its answer, and what it wrote.
        right: The answer, if the recording has these messages.
        code: Its exit code.
    """

    words: tuple[str, ...]
    read: Callable[[Answer, Path], Any]
    right: Callable[[Known], Any]
    code: int = 0


def asked(
    line: str,
    read: Callable[[Answer, Path], Any],
    right: Callable[[Known], Any],
    code: int = 0,
) -> Asked:
    """A command of words without spaces; ~ stands for a space."""
    return Asked(tuple(word.replace("~", " ") for word in line.split()), read, right, code)


def refused(line: str, code: int) -> Asked:
    """A command that is refused."""
    return asked(line, lambda answer, _: answer.out, lambda _: "", code)


def lines(*names: str) -> Callable[[Answer, Path], Any]:
    """Reads columns of JSON lines."""

    def read(answer: Answer, _: Path) -> Any:
        found = [json.loads(line) for line in answer.lines]
        return [tuple(one.get(name) for name in names) for one in found]

    return read


def listed(*names: str) -> Callable[[Answer, Path], Any]:
    """Reads columns of a JSON list."""

    def read(answer: Answer, _: Path) -> Any:
        return [tuple(one.get(name) for name in names) for one in answer.json]

    return read


def _csv(*names: str) -> Callable[[Answer, Path], Any]:
    def read(answer: Answer, _: Path) -> Any:
        return [tuple(row[n] for n in names) for row in csv.DictReader(io.StringIO(answer.out))]

    return read


def _mcap(_: Answer, out: Path) -> Any:
    with out.open("rb") as file:
        found = [
            (channel.topic, message.log_time, message.publish_time, message.data)
            for _, channel, message in make_reader(file).iter_messages()
        ]
    return sorted(found)


def _bag(_: Answer, out: Path) -> Any:
    with BagReader(out) as reader:
        return sorted((c.topic, time, bytes(raw)) for c, time, raw in reader.messages())


def _parquet(*names: str) -> Callable[[Answer, Path], Any]:
    def read(_: Answer, out: Path) -> Any:
        table = pq.read_table(out).select(names)
        return [tuple(row[name] for name in names) for row in table.to_pylist()]

    return read


def _raw(_: Answer, out: Path) -> Any:
    return sorted(path.read_bytes() for path in out.rglob("*.bin"))


def _pictures(_: Answer, out: Path) -> Any:
    found = [np.array(Image.open(path)).tolist() for path in sorted(out.glob("**/*.png"))]
    return sorted(found)


def _images(known: Known) -> Any:
    return sorted(np.array(_f(m)["data"]).reshape(6, 8, 3).tolist() for m in known.of("/cam"))


def _tables(_: Answer, out: Path) -> Any:
    return {path.stem.rpartition("__")[2]: pq.read_table(path).num_rows for path in out.iterdir()}


def _f(one: Any) -> dict[str, Any]:
    assert one.fields is not None
    fields: dict[str, Any] = one.fields
    return fields


def _page(_: Answer, out: Path) -> Any:
    return out.stat().st_size > 1000


def _info(answer: Answer, _: Path) -> Any:
    (one,) = answer.json
    names = ("status", "messages", "first_ns", "last_ns", "topics")
    counts = {t["topic"]: t["messages"] for t in one["channels"] if t["messages"]}
    return [one[n] for n in names], counts, [loss["count"] for loss in one["losses"]]


def _there(known: Known) -> dict[str, int]:
    return {topic: count for topic, count in known.counts.items() if count}


def _high(fields: dict[str, Any]) -> bool:
    return bool(fields["x"] > 50)


def _number(answer: Answer, _: Path) -> int:
    return int(answer.out)


def _messages(known: Known) -> Any:
    return sorted((m.topic, m.log_time, m.publish_time, m.raw) for m in known.of())


def _latched_front(known: Known) -> Any:
    """A slice of the last second, with the latched message that is in force when it begins."""
    begin = known.span[1] + 1 - SECOND
    front = [(topic, time, raw) for topic, time, raw in in_force(known, begin)]
    rest = known.of("/map", "/arm", between=(begin, known.span[1] + 1))
    return sorted([*front, *((m.topic, m.log_time, m.raw) for m in rest)])


COMMANDS: dict[str, list[Asked]] = {
    "ls": [
        asked(
            "ls --json",
            listed("name", "status", "messages", "first_ns", "last_ns", "topics"),
            lambda k: [(LABEL, "open", len(k.of()), *k.span, len(_there(k)))],
        ),
        asked(
            "ls --json --with said:~n~==~4 --has arm",
            listed("name"),
            lambda _: [(LABEL,)],
        ),
    ],
    "info": [
        asked(
            "info --json",
            _info,
            lambda k: (["open", len(k.of()), *k.span, len(_there(k))], _there(k), [3]),
        ),
        asked(
            f"info {LABEL}",
            lambda a, _: [
                line.split()[1] for line in a.lines if line.startswith(("messages", "status"))
            ],
            lambda k: ["being", str(len(k.of()))],
        ),
        asked(
            "info --json --sizes topic",
            lambda a, _: {r["topic"]: r["messages"] for r in a.json["rows"] if r.get("messages")},
            _there,
        ),
        asked(
            "info --losses --json",
            listed("recording", "topic", "cause", "count"),
            lambda _: [(LABEL, "/said", "transport", 3)],
        ),
        asked(
            "info -t arm --json",
            lambda a, _: (a.json[0]["type"], a.json[0]["recordings"]),
            lambda _: ("demo/msg/Arm", [LABEL]),
        ),
        asked(f"info {LABEL} --attachments --json", lambda a, _: a.json, lambda _: []),
    ],
    "fetch": [
        asked("fetch -t * --count", _number, lambda k: len(k.of())),
        asked("fetch -t said --count", _number, lambda k: len(k.of("/said"))),
        asked(
            "fetch -t said --where x~>~50 --count",
            _number,
            lambda k: len(k.of("/said", where=_high)),
        ),
        refused("fetch -t said --strict --count", 11),
        asked(
            "fetch -t said -F jsonl",
            lines("n", "big", "state"),
            lambda k: [(_f(m)["n"], _f(m)["big"], _f(m)["state"]) for m in k.of("/said")],
        ),
        asked(
            "fetch -t said --clock publish --between -1s end --count",
            _number,
            lambda k: len(ranged(k, "/said", "publish", -SECOND, None)),
        ),
        asked(
            "fetch -t arm -F jsonl --clock header --between +0s +1s --fields n",
            lines("n"),
            lambda k: [
                (_f(m)["n"],)
                for m in k.of(
                    "/arm",
                    between=(
                        k.clock_span("header", ["/arm"])[0],
                        k.clock_span("header", ["/arm"])[0] + SECOND,
                    ),
                    clock="header",
                )
            ],
        ),
        asked(
            "fetch -t arm -F csv --fields n,name",
            _csv("n", "name"),
            lambda k: [(str(_f(m)["n"]), _f(m)["name"]) for m in k.of("/arm")],
        ),
        asked(
            "fetch -t arm -F jsonl --at -0.1s --fields n",
            lines("n"),
            lambda k: [
                (_f([m for m in k.of("/arm") if m.log_time <= k.span[1] + 1 - 100 * MS][-1])["n"],)
            ],
        ),
        asked(
            "fetch -t said --reverse -n 5 -F jsonl --fields n",
            lines("n"),
            lambda k: [(_f(m)["n"],) for m in k.of("/said")[:-6:-1]],
        ),
        asked(
            "fetch -t said --every 7 -F jsonl --fields n",
            lines("n"),
            lambda k: [(_f(m)["n"],) for m in k.of("/said")[::7]],
        ),
        asked(
            "fetch -t arm -o OUT.parquet",
            _parquet("n", "position", "ranges"),
            lambda k: [(_f(m)["n"], _f(m)["position"], _f(m)["ranges"]) for m in k.of("/arm")],
        ),
        asked("fetch -t * -o OUT.mcap", _mcap, _messages),
        asked(
            "fetch -t map -t arm --between -1s end -o OUT.mcap",
            lambda a, out: [(topic, time, raw) for topic, time, _, raw in _mcap(a, out)],
            _latched_front,
        ),
        asked(
            "fetch -t map -o OUT.bag",
            _bag,
            lambda k: sorted((m.topic, m.log_time, m.raw) for m in k.of("/map")),
        ),
        asked("fetch -t cam -F raw -o OUT", _raw, lambda k: sorted(m.raw for m in k.of("/cam"))),
        asked("fetch -t cam -F png -o OUT", _pictures, _images),
    ],
    "intervals": [
        asked(
            "intervals -t said --where x~>~50 --json",
            listed("begin_ns", "end_ns", "messages"),
            lambda k: held(k, "/said", _high),
        ),
        asked(
            "intervals said --changes state --pause 0s --json",
            listed("begin_ns", "end_ns", "messages"),
            lambda k: changed(k, "/said", "state", 0),
        ),
        asked(
            "intervals cam --gaps --longer-than 100ms --json",
            lambda *told: between_messages(listed("begin_ns", "end_ns", "messages")(*told)),
            lambda k: between_messages(silent(k, "/cam", 100 * MS)),
        ),
    ],
    "align": [
        asked(
            "align --to arm -t said --fields arm:~n --fields said:~n -F jsonl",
            lines("arm.n", "said.n"),
            lambda k: [(own, near) for _, own, _, near in beside(k, "/arm", "/said")],
        ),
        asked(
            "align said --step 100ms -F jsonl",
            lines("log_time_ns", "distance"),
            lambda k: regular(k, "/said", SECOND // 10),
        ),
    ],
    "stats": [
        asked(
            "stats -t said --fields x --json",
            listed("topic", "field", "count", "nan", "infinite", "min", "max", "mean", "std"),
            lambda k: numbers(k, "/said", "x"),
        ),
    ],
    "check": [
        asked(
            "check --json",
            lambda a, _: {row["topic"]: row["messages"] for row in a.json},
            _there,
        ),
    ],
    "diff": [
        asked(f"diff {LABEL} {LABEL} --json", lambda a, _: a.json, lambda _: []),
    ],
    "plot": [
        asked("plot -t said --fields x -o OUT.png", _page, lambda _: True),
    ],
    "sql": [
        asked(
            "sql select~count(*)~n,~max(n)~last~from~said -F jsonl",
            lines("n", "last"),
            lambda k: [(len(k.of("/said")), max(_f(m)["n"] for m in k.of("/said")))],
        ),
        asked(
            "sql select~topic,~messages~from~topics~order~by~topic -F jsonl",
            lines("topic", "messages"),
            lambda k: sorted(_there(k).items()),
        ),
    ],
    "export": [
        asked("export OUT.mcap", _mcap, _messages),
        asked(
            "export OUT -F parquet -t arm -t said",
            _tables,
            lambda k: {t[1:]: k.counts[t] for t in ("/arm", "/said")},
        ),
    ],
    "verify": [
        asked("verify --json", lambda a, _: a.json["findings"], lambda _: []),
        asked("verify", lambda a, _: f"as far as sealed: {LABEL}" in a.err, lambda _: True),
        asked("verify --repair --json", lambda a, _: a.json["repaired"], lambda _: []),
    ],
    "index": [
        asked("index list --json", lambda a, _: a.json, lambda _: []),
        refused(f"index rebuild -r {LABEL}", 5),
        asked("index arrays arm --json", lambda a, _: a.json[0]["left"], lambda _: [LABEL]),
        asked("index arrays arm --off --json", lambda a, _: a.json[0]["topic"], lambda _: "/arm"),
    ],
    "keep": [
        # Sealed segments of a running recording are left to its recorder.
        asked("keep --max-age 0s --json", lambda a, _: a.json["plan"]["steps"], lambda _: []),
        asked("keep --pins --json", lambda a, _: a.json, lambda _: []),
    ],
    "edit": [
        asked(
            f"edit {LABEL} --name {LABEL}", lambda a, _: a.out, lambda _: f"renamed to {LABEL}\n"
        ),
        asked(f"edit {LABEL} --note quiet", lambda a, _: a.out, lambda _: ""),
    ],
    "tag": [
        asked(f"tag {LABEL} robot=7", lambda a, _: a.lines, lambda _: ["robot=7"]),
        refused(f"tag {LABEL} --remove nothing", 2),
        asked(f"tag {LABEL}", lambda a, _: a.lines, lambda _: ["robot=7"]),
    ],
    "mark": [refused(f"mark here -r {LABEL} --remove", 2)],
    "rm": [refused(f"rm {LABEL} --yes", 5)],
}
"""By name of the command."""

EXEMPT: dict[str, str] = {
    "record": "it makes recordings",
    "top": "it asks the recorder, not the store",
    "copy": "it copies recordings that have ended",
    "view": "it serves until it is stopped; see tests/view",
    "mcp": "it serves until it is stopped; see tests/view/test_tools.py",
    "open": "it serves until it is stopped; see tests/cli/test_serve.py",
    "demo": "it makes a recording",
    "tf": "these recordings have no transforms; see tests/tf/test_tree.py",
}
"""Commands without a rule here, and why."""


def place_for(words: tuple[str, ...], folder: Path) -> tuple[tuple[str, ...], Path]:
    """The words of a command with a path for its output, which does not exist, and the path."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    named = [word for word in words if word.startswith("OUT")]
    out = folder / (named[0].lower() if named else "out")
    return tuple(str(out) if word.startswith("OUT") else word for word in words), out
