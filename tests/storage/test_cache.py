"""The cache: what it keeps, and what makes room."""

from __future__ import annotations

from hybridlog_storage.cache import Cache


def test_those_that_were_not_asked_for_longest_go_first() -> None:
    cache, made = Cache(3500), list[int]()

    def get(number: int, size: int = 1000) -> bytes:
        def make() -> bytes:
            made.append(number)
            return bytes([number]) * size

        return cache.made("chunk", "a", number, make=make, size_of=len)

    for number in (1, 2, 3, 1, 4, 1, 2):
        assert get(number)[0] == number
    assert made == [1, 2, 3, 4, 2]  # 2 had to go for 4
    # A value without room is given, and not kept.
    for _ in range(2):
        assert get(5, size=4000) == b"\5" * 4000
    assert get(1)[0] == 1
    assert made == [1, 2, 3, 4, 2, 5, 5]


def test_another_value_takes_the_place_of_the_one_before_and_a_kind_is_dropped() -> None:
    cache = Cache(100)
    cache.put("chunk", 1, value="a", size=60)
    cache.put("chunk", 1, value="b", size=70)
    assert cache.get("chunk", 1) == "b"
    cache.put("density", 1, value="c", size=30)
    assert (cache.get("chunk", 1), cache.get("density", 1)) == ("b", "c")
    cache.drop("chunk")
    assert (cache.get("chunk", 1), cache.get("density", 1)) == (None, "c")
    cache.put("matches", 1, value="d", size=70)  # there is room for it
    assert cache.get("density", 1) == "c"
    cache.put("matches", 1, value="e", size=101)  # there is none: the old one holds no more
    assert cache.get("matches", 1) is None
