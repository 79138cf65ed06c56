"""Recordings whose clocks were wrong: at the beginning, at the end, and over all of time."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping

import pytest
from starlette.testclient import TestClient

import hybridlog as hl
from hybridlog_storage.messages import Channel, Schema
from tests.view.conftest import Asking
from tests.view.test_timeline import picture_of

MS = 10**6
LAST = 2**63 - 1
"""The last time that can be written."""
FAR = 2 * 10**18 + 2**62
COUNT = 300
TIMES: Mapping[str, list[int]] = {
    "zero": [n * MS for n in range(COUNT)],
    "far": [FAR + n * MS for n in range(COUNT)],
    "last": [LAST - COUNT + n + 1 for n in range(COUNT)],
    "all": [0, *(LAST - (COUNT - n) * MS for n in range(1, COUNT))],
}
EVERYTHING = {"begin": -LAST, "end": LAST}


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory, asking: Asking) -> Iterator[TestClient]:
    channel = Channel("/v", "ros1", Schema("own/V", "ros1msg", b"float64 v\nfloat64[] a\n"))
    with hl.open(tmp_path_factory.mktemp("times") / "store", create=True) as store:
        for label, times in TIMES.items():
            with store.start(label) as recording:
                for n, time in enumerate(times):
                    payload = struct.pack("<dI2d", n, 2, n, -n)
                    recording.write(channel, payload, log_time=time)
        yield asking(store)


@pytest.mark.parametrize("label", TIMES)
def test_pictures_at_the_ends_of_time(client: TestClient, label: str) -> None:
    times = TIMES[label]
    start, behind = times[0], times[-1] - times[0] + 1
    asked = {"recording": label, "topic": "/v", "pixels": 100}
    for span in (EVERYTHING, {"begin": -start, "end": min(behind, LAST)}):
        drawn = picture_of(client, {**asked, **span})
        assert int(drawn.lanes[0].counts.sum()) == COUNT
        rest = {**asked, **span, "pixels": 20}
        (series,) = client.get("series", params={**rest, "field": "v"}).json()["fields"]
        assert min(v for v in series["least"] if v is not None) == 0
        assert max(v for v in series["greatest"] if v is not None) == COUNT - 1
        for where in ("v > 9", "a[1] < -9"):
            found = client.get("matches", params={**rest, "where": where})
            assert sum(found.json()["counts"]) == COUNT - 10
        found = client.get("export-command", params={**span, "recording": label})
        assert found.json()["count"] == COUNT


def test_pixels_of_late_years(client: TestClient) -> None:
    asked = {"recording": "far", "topic": "/v", "begin": 0, "end": COUNT * MS, "pixels": 30}
    found = client.get("series", params={**asked, "field": "v"}).json()
    assert found["times"] == [str(n * 10 * MS) for n in range(30)]
    (one,) = found["fields"]
    assert one["least"] == [n * 10 for n in range(30)]
    assert one["greatest"] == [n * 10 + 9 for n in range(30)]


@pytest.mark.parametrize("label", TIMES)
def test_messages_at_the_ends_of_time(client: TestClient, label: str) -> None:
    times = TIMES[label]
    asked = {"recording": label, "topic": "/v"}
    at = [time - times[0] for time in times]
    for n in (0, 7, COUNT - 2):
        found = client.get("message", params={**asked, "at": at[n]}).json()
        assert (found["time"], found["until"]) == (str(at[n]), str(at[n + 1]))
    rows = client.get("match-list", params={**asked, "where": "v > 5", "at": at[-2], "count": 9})
    assert [int(time) for time, _ in rows.json()["rows"]] == at[-2:]
    assert rows.json()["before"] == COUNT - 8
    asked = {**asked, "where": "v > 5", "at": at[-1], "seq": 2**62, "direction": "earlier"}
    rows = client.get("match-list", params={**asked, "count": 1}).json()
    assert (rows["rows"][0][0], rows["before"]) == (str(at[-1]), COUNT - 7)
    text = f"select t, v from v where recording = '{label}' order by t desc limit 2"
    found = client.get("sql", params={"text": text}).json()
    assert found["at"] == [str(at[-1]), str(at[-2])]
