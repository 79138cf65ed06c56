"""The cache: what it keeps, and what makes room."""

from __future__ import annotations

from hybridlog_storage.cache import Cache


class Reading:
    """Counts what is made."""

    def __init__(self, cache: Cache) -> None:
        self._cache = cache
        self.made: list[int] = []

    def get(self, number: int, size: int = 1000) -> bytes:
        def make() -> bytes:
            self.made.append(number)
            return bytes([number]) * size

        return self._cache.made("chunk", "a", number, make=make, size_of=len)


def test_those_that_were_not_asked_for_longest_go_first() -> None:
    reading = Reading(Cache(3500))
    for number in (1, 2, 3, 1, 4, 1, 2):
        assert reading.get(number)[0] == number
    assert reading.made == [1, 2, 3, 4, 2]  # 2 had to go for 4


def test_a_value_without_room_is_given_and_not_kept() -> None:
    reading = Reading(Cache(3500))
    reading.get(1)
    assert len(reading.get(2, size=4000)) == 4000
    assert reading.get(2, size=4000)[0] == 2
    assert reading.get(1)[0] == 1
    assert reading.made == [1, 2, 2]


def test_another_value_takes_the_place_of_the_one_before() -> None:
    cache = Cache(100)
    cache.put("chunk", 1, value="a", size=60)
    cache.put("chunk", 1, value="b", size=70)
    assert cache.get("chunk", 1) == "b"
    cache.put("density", 1, value="c", size=30)
    assert (cache.get("chunk", 1), cache.get("density", 1)) == ("b", "c")
    cache.put("chunk", 1, value="d", size=101)  # has no room: the old one does not hold any more
    assert cache.get("chunk", 1) is None


def test_a_kind_is_dropped() -> None:
    cache = Cache(100)
    cache.put("chunk", 1, value="a", size=60)
    cache.put("density", 1, value="b", size=30)
    cache.drop("chunk")
    assert (cache.get("chunk", 1), cache.get("density", 1)) == (None, "b")
    cache.put("matches", 1, value="c", size=70)  # there is room for it
    assert cache.get("density", 1) == "b"
