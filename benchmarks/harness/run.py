"""One run: a load into a backend, and what came of it as seen from outside."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import usage
from benchmarks.backends.base import Backend
from benchmarks.harness.publisher import Counters
from benchmarks.loads.base import Load
from benchmarks.samples import Status
from benchmarks.side import SideError, Values, run_side, spelled, warm_cache

QUEUE = 10
"""Messages that the queue of a topic holds."""

_COUNT_S = 900.0
_COUNT_FAILED_S = 60.0
_START_S = 300.0


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of a run, as a sample wants it.

    Attributes:
        status: `ok`, `missing`, `failed`.
        values: What was measured; of a failure, until then.
        reason: Of a status that is not `ok`.
    """

    status: Status
    values: Mapping[str, Any]
    reason: str = ""


def run(load: Load, backend: type[Backend], directory: Path, speed: float = 1.0) -> Outcome:
    """Publish a load into a backend, close it, and count what another process finds in it.

    Values: `published`, `dropped`, `errors` (inserts that raised), `persisted` (counted
    afterwards), `lost` (taken without an error and not found), `topics` (published,
    dropped, persisted of each), `published_bytes`, `persisted_bytes`, `due_s` (from the
    first until the last message should be published), `publish_s` (until it was),
    `wall_s` (from the first publication until `finish` had returned), `cpu_s` of the logger,
    `server_cpu_s`, `server_peak_rss`, `peak_rss` (without the payloads), `disk_bytes`,
    `spin_ms`.
    """
    directory = directory.resolve()
    common = given_to(backend, load, directory)
    counters = directory / "counters"
    publishing = {"counters": str(counters), "speed": speed, "limit": QUEUE}
    timeout = 3 * load.duration_s / speed + _START_S
    warm_cache(load.payloads)
    try:
        arguments = {**common, "publishing": publishing}
        values = run_side("benchmarks.harness.logger:log", arguments, directory, timeout)
    except SideError as error:
        values = {"status": "failed", "reason": str(error)}
    status, reason = values.pop("status"), values.pop("reason")
    if "peak_rss" in values:
        values["peak_rss"] -= values.pop("peak_rss_payloads", 0)
    if status == "missing" or not counters.is_file():
        return Outcome(status, {}, reason)
    values["due_s"] = load.duration_s / speed
    values["disk_bytes"] = usage.disk_bytes(Path(common["directory"]))
    try:
        limit_s = _COUNT_S if status == "ok" else _COUNT_FAILED_S
        found = run_side("benchmarks.harness.logger:count", common, directory, limit_s)
    except SideError as error:
        found = {"status": "failed", "reason": str(error)}
    if status == "ok" and found["status"] != "ok":
        status, reason = "failed", f"opened again, it cannot be counted: {found['reason']}"
    counts = found.get("counts")
    wrong = _account(values, load, Counters(counters), counts)
    if status == "ok" and wrong:
        status, reason = "failed", wrong
    return Outcome(status, values, reason)


def given_to(backend: type[Backend], load: Load, directory: Path) -> dict[str, str]:
    """The arguments of a side: its backend gets the new folder `data` of the run's directory."""
    data = directory / "data"
    data.mkdir()
    return {
        "load": str(load.payloads.parent.resolve()),
        "backend": spelled(backend),
        "directory": str(data),
    }


def _account(
    values: Values, load: Load, counters: Counters, counts: Mapping[str, int] | None
) -> str:
    """Put what was published and what was found side by side; returns what does not fit."""
    published, dropped = _by_topic(load, counters.published()), _by_topic(load, counters.dropped)
    values["published"] = sum(published.values())
    values["dropped"] = sum(dropped.values())
    values["errors"] = sum(counters.errors)
    # In the order of the rows, so those that were due are the first ones.
    values["published_bytes"] = int(load.length[: values["published"]].sum())
    values["topics"] = {topic: [n, dropped[topic]] for topic, n in published.items()}
    if counts is None:
        return ""
    for topic, row in values["topics"].items():
        row.append(counts.get(topic, 0))
    persisted = sum(counts.values())
    values["persisted"] = persisted
    values["lost"] = sum(counters.taken) - values["errors"] - persisted
    if persisted == values["published"]:
        values["persisted_bytes"] = values["published_bytes"]
    else:
        means = _mean_lengths(load)
        values["persisted_bytes"] = round(sum(n * means.get(t, 0.0) for t, n in counts.items()))
    for topic, count in counts.items():
        if count > published.get(topic, 0) - dropped.get(topic, 0):
            return (
                f"{topic}: {count} messages were found, more than the "
                f"{published.get(topic, 0) - dropped.get(topic, 0)} that it was given"
            )
    return ""


def _by_topic(load: Load, numbers: list[int] | memoryview) -> Counter[str]:
    """Numbers of channels added up by topic: a topic may have several channels."""
    found: Counter[str] = Counter()
    for channel, number in zip(load.channels, numbers, strict=True):
        found[channel.topic] += number
    return found


def _mean_lengths(load: Load) -> dict[str, float]:
    """Mean payload length of each topic, bytes."""
    counts = np.bincount(load.channel, minlength=len(load.channels))
    sums = np.bincount(load.channel, weights=load.length, minlength=len(load.channels))
    messages = _by_topic(load, counts.tolist())
    lengths = _by_topic(load, sums.tolist())
    return {topic: lengths[topic] / count for topic, count in messages.items() if count}
