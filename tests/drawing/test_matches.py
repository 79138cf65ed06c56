"""Matches against loops over what was written."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from hybridlog.drawing.times import Episode, Match, Matches, aligned
from hybridlog_storage.errors import ResourceError
from tests.limits import Limit

from .conftest import BASE, MS, Drive

PREDICATE = "linear.z > 0.5 and on == true"


def matching(drive: Drive) -> list[Match]:
    """Arrival numbers are those of the log, which has a message of /loose behind each 50th."""
    wanted = np.flatnonzero((drive.z > 0.5) & (np.arange(len(drive.z)) % 2 == 1))
    return [Match(int(drive.times[n]), int(n + (n - 1) // 50 + 1)) for n in wanted]


def test_ticks_count_each_match_once(drive: Drive) -> None:
    matches = Matches(drive.store.topic("drive").where(PREDICATE))
    times = [one.time for one in matching(drive)]
    whole = BASE, times[-1] + 1
    for pixels, span in ((1, whole), (97, whole), (500, (times[10], times[90])), (8, (0, BASE))):
        edges = aligned(span, pixels)
        first, counts = matches.ticks(edges)
        want = Counter(int(np.searchsorted(edges, time, "right")) for time in times)
        shown = {pixel: many for pixel, many in want.items() if 0 < pixel < len(edges)}
        assert counts.tolist() == [shown[pixel] for pixel in sorted(shown)]
        parts = [(int(edges[pixel - 1]), int(edges[pixel])) for pixel in sorted(shown)]
        assert first.tolist() == [min(t for t in times if a <= t < b) for a, b in parts]
    assert len(times) > 500


def test_bands_are_the_intervals_as_far_as_pixels_tell(drive: Drive) -> None:
    query = drive.store.topic("drive").where("linear.z > 0.5")
    span = BASE + 1234, int(drive.times[-1]) + 10 * MS
    exact = [(i.begin_ns, i.end_ns) for i in query.between(*span).intervals()]
    assert len(exact) > 5
    assert Matches(query).bands(span, 1).tolist() == [list(one) for one in exact]
    alternating = drive.store.topic("drive").where("on == true")
    exact_width = int(drive.times[0]), int(drive.times[100])  # of 10 ms, as the bands' distance
    for pixels, picture in ((1, span), (10, span), (300, span), (100, exact_width)):
        all_of_it = [(i.begin_ns, i.end_ns) for i in alternating.between(*picture).intervals()]
        width = -(-(picture[1] - picture[0]) // pixels)
        found = Matches(alternating).bands(picture, width).tolist()
        want: list[list[int]] = []
        for begin, end in all_of_it:
            if want and begin - want[-1][1] < width:
                want[-1][1] = end
            else:
                want.append([begin, end])
        assert found == want
        assert len(found) <= pixels + 1
    assert Matches(query).bands((0, BASE - 1), 7 * MS).tolist() == []


def test_bands_last_until_the_recording_ends(drive: Drive) -> None:
    query = drive.store.topic("loose").where("name exists")
    end = int(drive.times[-1])
    assert Matches(query).bands((end - 5 * MS, end + 1), 9).tolist() == [[end - 5 * MS, end + 1]]


@pytest.mark.parametrize("count", [1, 7, 5000])
def test_episodes_step_by_step(drive: Drive, count: int) -> None:
    """Each other message matches, so each match is an episode that lasts until the next message."""
    matches = Matches(drive.store.topic("drive").where(PREDICATE))
    ends = np.append(drive.times[1:], drive.times[-1] + 1)
    until = dict(zip(drive.times.tolist(), ends.tolist(), strict=True))
    want = [Episode(one, until[one.time], 1) for one in matching(drive)]
    assert matches.episodes == len(want)
    middle = want[300].first
    for place in (middle, Match(middle.time, -1), Match(BASE - 9, -1), Match(2**62, -1)):
        later = [one for one in want if one.first > place]
        earlier = [one for one in want if one.first < place]
        assert matches.beside(place, count, earlier=False) == later[:count]
        assert matches.beside(place, count, earlier=True) == earlier[-count:]
        assert matches.count_before(place) == len(earlier)


def test_an_episode_is_an_interval(drive: Drive) -> None:
    query = drive.store.topic("drive").where("linear.z > 0.5")
    found = Matches(query).beside(Match(0, -1), 5000, earlier=False)
    assert [(one.first.time, one.end) for one in found] == [
        (each.begin_ns, each.end_ns) for each in query.intervals()
    ]
    assert sum(one.n for one in found) == query.count() > len(found)


def test_more_matches_than_fit_are_refused(drive: Drive, limit: Limit) -> None:
    count = len(matching(drive))
    limit(matches=count)
    assert Matches(drive.store.topic("drive").where(PREDICATE)).size >= 16 * count
    limit(matches=count - 1)
    with pytest.raises(ResourceError, match="write a narrower predicate"):
        Matches(drive.store.topic("drive").where(PREDICATE))
