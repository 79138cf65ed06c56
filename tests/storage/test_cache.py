"""The cache: what it keeps, and what makes room."""

from __future__ import annotations

from hybridlog_storage.cache import Cache, Kind


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


def test_a_kind_is_dropped() -> None:
    cache, made = Cache(100), list[int]()

    def get(kind: Kind, size: int) -> None:
        cache.made(kind, 1, make=lambda: made.append(size), size_of=lambda _: size)

    get("chunk", 70)
    get("times", 30)
    cache.drop("chunk")
    for kind, size in (("times", 30), ("chunk", 70), ("times", 30), ("chunk", 70)):
        get(kind, size)  # type: ignore[arg-type]
    assert made == [70, 30, 70]
