"""ROS messages as bytes, many at a time.

Most topics say the same thing in the same length over and over: rosbags serialises
one message, and the numbers that change are written into copies of it by column.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.base import normalize_fieldname

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray
    from rosbags.typesys.store import Typestore

GRIPPER_COMMAND = "pr2_controllers_msgs/msg/Pr2GripperCommand"
_GRIPPER_DEFINITION = """\
# Wanted opening of the gripper
float64 position    # metres between the fingers, 0.0 is closed
float64 max_effort  # newtons, negative for no limit
"""
_TF_DEFINITION = "geometry_msgs/TransformStamped[] transforms\n"

# Kinds of nodes in the field descriptions of rosbags.
_BASE, _NAME, _ARRAY, _SEQUENCE = 1, 2, 3, 4

_DTYPES: dict[str, str] = {
    "bool": "u1",
    "byte": "u1",
    "octet": "u1",
    "char": "u1",
    "uint8": "u1",
    "int8": "i1",
    "uint16": "<u2",
    "int16": "<i2",
    "uint32": "<u4",
    "int32": "<i4",
    "uint64": "<u8",
    "int64": "<i8",
    "float32": "<f4",
    "float64": "<f8",
}
_TIME = "builtin_interfaces/msg/Time"


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a value lies: first byte, type of one element, number of elements."""

    offset: int
    dtype: str
    count: int


class Template:
    """A serialised message, and where its values lie.

    Attributes:
        data: The message, uint8[size].
        size: Its length in bytes.
    """

    def __init__(self, data: bytes, places: dict[str, _Place]) -> None:
        self.data: NDArray[np.uint8] = np.frombuffer(data, np.uint8)
        self.size = len(data)
        self._places = places

    def rows(self, columns: Mapping[str, NDArray[Any]], count: int) -> NDArray[np.uint8]:
        """Copies of the message with other values.

        Args:
            columns: By field path (`pose.position.x`, `transforms.0.header.stamp`),
                shape (count,) or (count, elements). Times are int64 nanoseconds.
                A path that ends in `seq` may be absent (ROS 2 has none); any other
                absent path is a KeyError.
            count: Number of messages.

        Returns:
            uint8[count, size].
        """
        out = np.empty((count, self.size), np.uint8)
        out[:] = self.data
        for path, values in columns.items():
            if path.endswith("seq") and path not in self._places:
                continue
            self._put(out, self._places[path], values)
        return out

    def view(self, rows: NDArray[np.uint8], path: str) -> NDArray[np.uint8]:
        """The bytes of one field in `rows`, uint8[count, bytes], to be written to."""
        place = self._places[path]
        end = place.offset + np.dtype(place.dtype).itemsize * place.count
        return rows[:, place.offset : end]

    @staticmethod
    def _put(out: NDArray[np.uint8], place: _Place, values: NDArray[Any]) -> None:
        if place.dtype == _TIME:
            seconds, nanoseconds = np.divmod(values, 1_000_000_000)
            values, dtype = np.stack((seconds, nanoseconds), axis=1), "<u4"
        else:
            dtype = place.dtype
        block = np.ascontiguousarray(values, dtype).reshape(len(out), place.count)
        raw = block.view(np.uint8).reshape(len(out), -1)
        out[:, place.offset : place.offset + raw.shape[1]] = raw


class Types:
    """The message types of one ROS version.

    Args:
        ros: 1 or 2.
    """

    def __init__(self, ros: Literal[1, 2]) -> None:
        self.ros = ros
        self.store: Typestore = get_typestore(
            Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE
        )
        self.store.register(get_types_from_msg(_GRIPPER_DEFINITION, GRIPPER_COMMAND))
        if ros == 1:
            self.store.register(get_types_from_msg(_TF_DEFINITION, "tf2_msgs/msg/TFMessage"))
        self.log_type = "rosgraph_msgs/msg/Log" if ros == 1 else "rcl_interfaces/msg/Log"

    def encode(self, msgtype: str, values: Mapping[str, object]) -> bytes:
        """One message as bytes; see `template` for `values`."""
        message = self._build(msgtype, values)
        if self.ros == 1:
            return bytes(self.store.serialize_ros1(message, msgtype))
        return bytes(self.store.serialize_cdr(message, msgtype, little_endian=True))

    def template(self, msgtype: str, values: Mapping[str, object]) -> Template:
        """A message to be copied.

        Args:
            msgtype: Type name as rosbags spells it.
            values: By field name, nested for nested messages. Fields that are not
                named are zero or empty; names that this ROS version does not have are
                left out; case does not matter (`D` of ROS 1 is `d` in ROS 2). A time
                is an int of nanoseconds.
        """
        data = self.encode(msgtype, values)
        places: dict[str, _Place] = {}
        walk = _Walk(self.store, places, aligned=self.ros == 2)
        end = walk.message(msgtype, self._build(msgtype, values), 0, "")
        if end + walk.base != len(data):
            raise AssertionError(f"layout of {msgtype} has {end} bytes, not {len(data)}")
        return Template(data, places)

    def _build(self, msgtype: str, values: Mapping[str, object]) -> object:
        if msgtype == _TIME:
            raise AssertionError("a time is given as an int")
        lower = {name.lower(): value for name, value in values.items()}
        fields: dict[str, Any] = {}
        for name, (kind, detail) in self.store.fielddefs[msgtype][1]:
            fields[normalize_fieldname(name)] = self._value(
                int(kind), detail, lower.get(name.lower())
            )
        return self.store.types[msgtype](**fields)

    def _value(self, kind: int, detail: Any, value: Any) -> Any:
        if kind == _BASE:
            empty: object = "" if detail[0] == "string" else 0
            return empty if value is None else value
        if kind == _NAME and detail == _TIME:
            seconds, nanoseconds = divmod(value or 0, 1_000_000_000)
            return self.store.types[_TIME](seconds, nanoseconds)
        if kind == _NAME:
            return self._build(detail, value or {})
        (inner, what), count = detail
        if int(inner) == _NAME:
            return [self._build(what, item) for item in value or ()]
        if what[0] == "string":
            return list(value or ())
        if value is None:
            value = [0] * (count if kind == _ARRAY else 0)
        return np.asarray(value, _DTYPES[what[0]])


class _Walk:
    """Finds the place of every value of a message in its serialised form."""

    def __init__(self, store: Typestore, places: dict[str, _Place], *, aligned: bool) -> None:
        self._store = store
        self._places = places
        self._aligned = aligned
        # CDR starts with four bytes that alignment does not count.
        self.base = 4 if aligned else 0

    def message(self, msgtype: str, message: object, at: int, prefix: str) -> int:
        """Note the places of all fields; returns the byte after the last."""
        fields: list[tuple[str, Any]] = list(self._store.fielddefs[msgtype][1])
        for name, (kind, detail) in fields:
            value = getattr(message, normalize_fieldname(name))
            path = prefix + name.lower()
            if int(kind) == _BASE:
                at = self._base(detail[0], value, at, path)
            elif int(kind) == _NAME:
                at = self._nested(detail, value, at, path)
            else:
                at = self._elements(detail, value, at, path, counted=int(kind) == _SEQUENCE)
        return at

    def _align(self, at: int, size: int) -> int:
        return -(-at // size) * size if self._aligned else at

    def _base(self, name: str, value: Any, at: int, path: str) -> int:
        if name == "string":
            return self._align(at, 4) + 4 + len(value.encode()) + (1 if self._aligned else 0)
        size = np.dtype(_DTYPES[name]).itemsize
        at = self._align(at, size)
        self._places[path] = _Place(self.base + at, _DTYPES[name], 1)
        return at + size

    def _nested(self, msgtype: str, value: object, at: int, path: str) -> int:
        if msgtype == _TIME:
            at = self._align(at, 4)
            self._places[path] = _Place(self.base + at, _TIME, 2)
            return at + 8
        return self.message(msgtype, value, at, path + ".")

    def _elements(self, detail: Any, value: Any, at: int, path: str, *, counted: bool) -> int:
        (inner, what), _ = detail
        if counted:
            at = self._align(at, 4) + 4
        if int(inner) == _NAME:
            for number, item in enumerate(value):
                at = self._nested(what, item, at, f"{path}.{number}")
            return at
        if what[0] == "string":
            for number, item in enumerate(value):
                at = self._base("string", item, at, f"{path}.{number}")
            return at
        size = np.dtype(_DTYPES[what[0]]).itemsize
        if len(value):
            at = self._align(at, size)
        self._places[path] = _Place(self.base + at, _DTYPES[what[0]], len(value))
        return at + size * len(value)
