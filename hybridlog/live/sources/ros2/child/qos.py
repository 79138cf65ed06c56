"""Quality of service: offers of publishers, requests of subscriptions, conflicts.

Policies are the numbers of rmw, durations are nanoseconds.
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
"""Duration that means no limit in rmw, ns."""

DEPTH = 10_000
"""Messages that the middleware queues for a subscription, enough for a burst.

The queue takes memory only for messages that it holds.
"""

DEPTH_OF_ARRAYS = 1000
"""The same for types with arrays of any length, which may be large."""

DEPTH_OF_BYTES = 256
"""The same for types with byte arrays, such as images and point clouds, which are large."""

_SECOND = 1_000_000_000


class Profile(NamedTuple):
    """Quality of service of one end of a topic.

    Attributes:
        history: `KEEP_LAST`, `KEEP_ALL`, or 0 or 3 when unknown.
        depth: Length of the queue, for `KEEP_LAST`.
        reliability: `RELIABLE`, `BEST_EFFORT`, or another number that is unknown.
        durability: `TRANSIENT_LOCAL`, `VOLATILE`, or another number.
        deadline: Maximum time between two messages, ns; 0 or `FOREVER` for none.
        lifespan: Time for which a message is delivered, ns.
        liveliness: `AUTOMATIC`, `MANUAL_BY_TOPIC`, or another number.
        liveliness_lease_duration: Time after which a silent publisher counts as dead, ns.
        avoid_ros_namespace_conventions: The DDS topic has the plain name.
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
    """A request that is compatible with all publishers, of which there is at least one.

    It has the reliability and durability that all of them offer. A deadline or a lease would only
    exclude publishers. `override` has fields of `Profile` that the user has set.
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
    """Names of the policies that make a publisher incompatible."""
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
    """A duration, with `FOREVER` for none."""
    return FOREVER if duration <= 0 else duration


def offered_text(offers: Sequence[Profile]) -> str:
    """Profiles of publishers as a YAML list, as in the metadata of bags."""
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
