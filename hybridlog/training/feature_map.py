"""The map from topics and fields to features of a training set.

A map is YAML:

    robot_type: turtlebot
    features:
      observation.state:
        - joint_states: position
        - odom: twist.twist.linear.x
      action:
        - cmd_vel: [linear.x, angular.z]
    images:
      front: /front/image_raw
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeAlias

from msgspec import Meta, Struct, ValidationError, convert

from hybridlog.arrays.message_arrays import IMAGES, plain_type
from hybridlog.formats.yaml_values import YamlError, parse_yaml, read_yaml
from hybridlog.wording import listed
from hybridlog_storage.errors import TopicError, UsageError

if TYPE_CHECKING:
    from hybridlog.query.query import Query
    from hybridlog.session import Session

IMAGE_PREFIX: Final = "observation.images."
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.\-]{0,63}")
_OWN = frozenset({"timestamp", "frame_index", "episode_index", "index", "task_index", "task"})
_STATES: Final = {
    "sensor_msgs/JointState": ("position",),
    "nav_msgs/Odometry": ("twist.twist.linear.x", "twist.twist.angular.z"),
}
_ACTIONS: Final = {
    "geometry_msgs/Twist": ("linear.x", "angular.z"),
    "geometry_msgs/TwistStamped": ("twist.linear.x", "twist.angular.z"),
    "sensor_msgs/Joy": ("axes",),
    "std_msgs/Float64MultiArray": ("data",),
}


_Parts: TypeAlias = dict[str, str | Annotated[list[str], Meta(min_length=1)]]


class _Given(Struct, forbid_unknown_fields=True):
    """A map as it is written."""

    features: dict[str, list[_Parts] | _Parts] = {}
    images: dict[str, Annotated[str, Meta(min_length=1)]] = {}
    robot_type: str = ""


@dataclass(frozen=True, slots=True)
class Source:
    """Fields of a topic, numbers or arrays of numbers, that are a part of a feature."""

    topic: str
    paths: tuple[str, ...]


class FeatureMap(Struct, frozen=True):
    """Features of a training set.

    Attributes:
        vectors: Parts by name of the feature, such as `action`.
        images: Topics by name of the camera.
        robot_type: Name of the robot; empty if unknown.
    """

    vectors: Mapping[str, tuple[Source, ...]]
    images: Mapping[str, str]
    robot_type: str = ""

    @property
    def topics(self) -> tuple[str, ...]:
        """All topics, each once."""
        parts = (part.topic for parts in self.vectors.values() for part in parts)
        return tuple(dict.fromkeys([*parts, *self.images.values()]))

    def resolved(self, session: Session) -> FeatureMap:
        """The map with full names of topics."""
        full = {name: session.resolve_in([name], None) for name in self.topics}
        if several := [name for name, found in full.items() if len(found) > 1]:
            raise TopicError(f"{several[0]} means several topics: {listed(full[several[0]])}.")
        return FeatureMap(
            {
                name: tuple(Source(full[one.topic][0], one.paths) for one in parts)
                for name, parts in self.vectors.items()
            },
            {name: full[topic][0] for name, topic in self.images.items()},
            self.robot_type,
        )

    @classmethod
    def given(cls, features: str | Path | Mapping[str, Any]) -> FeatureMap:
        """A map of plain values, or from a file."""
        return cls.read(features) if isinstance(features, str | Path) else cls.of(features)

    @classmethod
    def read(cls, path: str | Path) -> FeatureMap:
        """Read a map from a file; a `UsageError` says where it is wrong and what to write."""
        text = read_yaml(path, "map of features")
        try:
            return cls.of(parse_yaml(text), str(path))
        except YamlError as error:
            raise UsageError(f"{path} is no YAML: {error}.") from error

    @classmethod
    def of(cls, values: object, name: str = "the map") -> FeatureMap:
        """A map of plain values; a `UsageError` says where they are wrong."""
        try:
            given = convert(values, _Given)
        except ValidationError as error:
            raise UsageError(f"{name}: {error}; --propose-map shows how it is written.") from error
        for key in (*given.features, *given.images):
            if not _NAME.fullmatch(key) or key in _OWN or key.startswith(IMAGE_PREFIX):
                raise UsageError(
                    f"{name}: {key!r} is no name for a feature; name it like observation.state."
                )
        if not given.features and not given.images:
            raise UsageError(f"{name}: it has no features; --propose-map writes a map.")
        vectors = {
            key: tuple(
                Source(topic, (paths,) if isinstance(paths, str) else tuple(paths))
                for row in (parts if isinstance(parts, list) else [parts])
                for topic, paths in row.items()
            )
            for key, parts in given.features.items()
        }
        return cls(vectors, given.images, given.robot_type)

    def to_yaml(self) -> str:
        """The map as YAML."""
        import yaml

        vectors = {
            name: [{part.topic: [*part.paths]} for part in parts]
            for name, parts in self.vectors.items()
        }
        parts = {"robot_type": self.robot_type, "features": vectors, "images": {**self.images}}
        return "".join(
            yaml.dump(
                {key: value},
                Dumper=yaml.CSafeDumper,
                default_flow_style=None if key == "features" else False,
                sort_keys=False,
                allow_unicode=True,
                width=1 << 20,
            )
            for key, value in parts.items()
            if value
        )


def proposed(query: Query) -> FeatureMap:
    """A map for the topics of a question, by their types.

    Joint states and odometry become states, commands become actions, images of all encodings and
    videos become images. Without such topics there is a `UsageError`.
    """
    states: list[Source] = []
    actions: list[Source] = []
    images: dict[str, str] = {}
    entries = map(query.source.now().entry_of, query.source.now().summaries_of(query.question))
    types = {one.topic: plain_type(one.type) for entry in entries for one in entry.channels}
    for topic in query.topics:
        kind = types.get(topic, "")
        if kind in _STATES:
            states.append(Source(topic, _STATES[kind]))
        elif kind in _ACTIONS:
            actions.append(Source(topic, _ACTIONS[kind]))
        elif kind in IMAGES:
            words = [word for word in re.split(r"[^A-Za-z0-9]+", topic) if word]
            plain = [word for word in words if word not in {"image", "raw", "color", "compressed"}]
            name = "_".join(plain or words)
            images[name if name not in images else f"{name}_{len(images)}"] = topic
    named = {"observation.state": tuple(states), "action": tuple(actions)}
    found = FeatureMap({name: parts for name, parts in named.items() if parts}, images)
    if not found.topics:
        raise UsageError(
            "There are no joint states, odometry, commands or images: write the map by hand."
        )
    return found
