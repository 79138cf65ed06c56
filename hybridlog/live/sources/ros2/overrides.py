"""QoS overrides of the user: a YAML file in the format of rosbag2.

/tf_static:
  history: keep_last
  depth: 10
  reliability: reliable
  durability: transient_local
  deadline: {sec: 1, nsec: 0}
"""

from __future__ import annotations

import reprlib
from typing import TYPE_CHECKING, Any

from hybridlog.formats.yaml_values import YamlError, parse_yaml, read_yaml
from hybridlog.live.sources.ros2.child.qos import DURATIONS, FOREVER, Profile
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from pathlib import Path

MAX_DEPTH = 1_000_000

_POLICIES = {
    "history": {"system_default": 0, "keep_last": 1, "keep_all": 2},
    "reliability": {"system_default": 0, "reliable": 1, "best_effort": 2},
    "durability": {"system_default": 0, "transient_local": 1, "volatile": 2},
    "liveliness": {"system_default": 0, "automatic": 1, "manual_by_topic": 3},
}


def read_overrides(path: Path) -> dict[str, dict[str, Any]]:
    """Reads the overrides: fields of `Profile` by topic."""
    data = read_yaml(path, "QoS overrides")
    try:
        root = parse_yaml(data)
    except YamlError as error:
        raise UsageError(f"{path}: invalid YAML: {error}") from error
    if root is None:
        return {}
    if not isinstance(root, dict):
        raise UsageError(f"{path}: topics with policies below them are expected")
    found = {}
    for topic, policies in root.items():
        if not isinstance(topic, str) or not isinstance(policies, dict):
            raise UsageError(
                f"{path}: {reprlib.repr(topic)}: a topic with policies below it is expected"
            )
        name = topic if topic.startswith("/") else f"/{topic}"
        found[name] = {
            str(key): _policy(key, value, f"{path}: {topic}") for key, value in policies.items()
        }
    return found


def _policy(name: object, value: object, where: str) -> int:
    """The number of a policy."""
    if name in DURATIONS:
        return _duration(value, f"{where}: {name}")
    if name == "depth":
        if isinstance(value, bool) or not isinstance(value, int) or not 0 < value <= MAX_DEPTH:
            raise UsageError(
                f"{where}: depth is a number from 1 to {MAX_DEPTH}, not {reprlib.repr(value)}"
            )
        return value
    if name == "avoid_ros_namespace_conventions":
        if not isinstance(value, bool):
            raise UsageError(f"{where}: {name} is true or false, not {reprlib.repr(value)}")
        return value
    words = _POLICIES.get(name) if isinstance(name, str) else None
    if words is None:
        known = ", ".join(Profile._fields)
        raise UsageError(f"{where}: unknown policy {name!r}; choose one of {known}")
    number = words.get(value.lower()) if isinstance(value, str) else None
    if number is None:
        raise UsageError(f"{where}: {name} is one of {', '.join(words)}, not {reprlib.repr(value)}")
    return number


def _duration(value: object, where: str) -> int:
    """A duration in ns."""
    if isinstance(value, dict) and set(value) == {"sec", "nsec"}:
        sec, nsec = value["sec"], value["nsec"]
        if all(isinstance(part, int) and part >= 0 for part in (sec, nsec)):
            return int(min(sec * 1_000_000_000 + nsec, FOREVER))
    raise UsageError(f"{where} is a duration, {{sec: 1, nsec: 0}}, not {reprlib.repr(value)}")
