"""Quality of service: what publishers offer, what we ask for, whether both fit.

Policies are the numbers that rmw has for them, durations nanoseconds.

Runs under Python 3.10 as well, with nothing but the standard library.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

KEEP_LAST, KEEP_ALL = 1, 2
RELIABLE, BEST_EFFORT = 1, 2
TRANSIENT_LOCAL, VOLATILE = 1, 2
AUTOMATIC, MANUAL_BY_TOPIC = 1, 3

FOREVER = 2**63 - 1
"""Duration that rmw takes for no limit, ns."""

DEPTH = 10_000
"""Messages that the middleware keeps for us: a burst, while we are about something else.

It takes memory for those that are there only.
"""

DEPTH_OF_ARRAYS = 1000
"""The same for types that may be large: with arrays of any length."""

DEPTH_OF_BYTES = 256
"""The same for types that are large: with arrays of bytes, images and point clouds."""

_SECOND = 1_000_000_000


class Profile(NamedTuple):
    """Quality of service of one end of a topic.

    Attributes:
        history: `KEEP_LAST`, `KEEP_ALL`, or 0 or 3 when unknown.
        depth: Messages that are kept, for `KEEP_LAST`.
        reliability: `RELIABLE`, `BEST_EFFORT`, or another number that is unknown.
        durability: `TRANSIENT_LOCAL`, `VOLATILE`, or another number.
        deadline: ns between two messages at most, 0 or `FOREVER` for no such promise.
        lifespan: ns for which a message is worth being delivered.
        liveliness: `AUTOMATIC`, `MANUAL_BY_TOPIC`, or another number.
        liveliness_lease_duration: ns until a silent publisher counts as dead.
        avoid_ros_namespace_conventions: The topic has its plain name in DDS.
    """

    history: int = KEEP_LAST
    depth: int = DEPTH
    reliability: int = RELIABLE
    durability: int = VOLATILE
    deadline: int = 0
    lifespan: int = 0
    liveliness: int = AUTOMATIC
    liveliness_lease_duration: int = 0
    avoid_ros_namespace_conventions: bool = False


DURATIONS = ("deadline", "lifespan", "liveliness_lease_duration")


def request(offers: Sequence[Profile], depth: int, override: Mapping[str, Any]) -> Profile:
    """What to ask for, so that all publishers are heard.

    The reliability and durability that all of them offer; no deadline, no lease, which
    would only exclude some.

    Args:
        offers: What the publishers offer, at least one.
        depth: Messages to keep.
        override: Fields of `Profile` that the user wants otherwise.
    """
    reliable = all(offer.reliability == RELIABLE for offer in offers)
    lasting = all(offer.durability == TRANSIENT_LOCAL for offer in offers)
    found = Profile(
        depth=depth,
        reliability=RELIABLE if reliable else BEST_EFFORT,
        durability=TRANSIENT_LOCAL if lasting else VOLATILE,
    )
    return found._replace(**override)


def conflicts(offer: Profile, wanted: Profile) -> list[str]:
    """Names of the policies because of which a publisher is not heard.

    Args:
        offer: The publisher's.
        wanted: The subscription's.
    """
    found = []
    if wanted.reliability == RELIABLE and offer.reliability == BEST_EFFORT:
        found.append("reliability")
    if wanted.durability == TRANSIENT_LOCAL and offer.durability == VOLATILE:
        found.append("durability")
    if _limit(offer.deadline) > _limit(wanted.deadline):
        found.append("deadline")
    if wanted.liveliness == MANUAL_BY_TOPIC and offer.liveliness == AUTOMATIC:
        found.append("liveliness")
    if _limit(offer.liveliness_lease_duration) > _limit(wanted.liveliness_lease_duration):
        found.append("liveliness_lease_duration")
    return found


def _limit(duration: int) -> int:
    """A duration, where none is the longest of all."""
    return FOREVER if duration <= 0 else duration


def offered_text(offers: Sequence[Profile]) -> str:
    """What publishers offer, as the metadata of bags have it: a list in YAML."""
    lines: list[str] = []
    for offer in offers:
        mark = "- "
        for name, value in zip(Profile._fields, offer, strict=True):
            if name in DURATIONS:
                lines += [
                    f"  {name}:",
                    f"    sec: {value // _SECOND}",
                    f"    nsec: {value % _SECOND}",
                ]
            else:
                shown = str(value).lower() if isinstance(value, bool) else str(value)
                lines.append(f"{mark}{name}: {shown}")
            mark = "  "
    return "\n".join(lines)
