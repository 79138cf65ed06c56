"""Maps topics one-to-one to names of MongoDB collections.

The plain rule (drop the leading slash, `/` becomes `__`) maps `/a/b`, `/a__b` and `a/b`
to one name. It is used for canonical names only, where it is reversible. The name of any
other topic contains a part of its hash.
"""

from __future__ import annotations

import hashlib
import re
from functools import lru_cache

CATALOG_PREFIX = "hybridlog."
"""Catalog collections start with this; no topic's collection has a dot in its name."""

_CANONICAL = re.compile(r"(?:/[A-Za-z0-9]+(?:_[A-Za-z0-9]+)*)+")
_ODD = re.compile(r"[^A-Za-z0-9_]")
_LONGEST = 120  # a MongoDB namespace (database.collection) has at most 255 bytes


@lru_cache(maxsize=4096)
def collection_of(topic: str) -> str:
    """The collection that holds the index documents of a topic.

    `r_gripper_controller__command` for `/r_gripper_controller/command`; for a topic that is not a
    canonical ROS name, a readable form, `~` and eight hex digits.
    """
    if _CANONICAL.fullmatch(topic) and len(topic) <= _LONGEST:
        return topic[1:].replace("/", "__")
    digest = hashlib.sha256(topic.encode("utf-8", "surrogatepass")).hexdigest()[:8]
    readable = _ODD.sub("_", topic.removeprefix("/").replace("/", "__"))[:100]
    return f"{readable}~{digest}"
