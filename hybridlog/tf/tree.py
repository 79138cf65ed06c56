"""Rigid transforms, and the tree of frames: which frame hangs on which, when, and how to get there.

Transforms are numpy arrays: one, or one for each of many times.

The rules are those of tf2. A frame has one parent at a time, named by its latest transform.
Between two transforms the pose is interpolated; before the first and after the last there is
none. Static transforms hold at all times. Stamps are those of the headers.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from msgspec import Struct, field

from hybridlog.query.times import TimeLike, format_time, parse_time
from hybridlog.wording import arrow_html, counted, listed
from hybridlog_storage.errors import TopicError, TransformError, UsageError

if TYPE_CHECKING:
    import pyarrow as pa
    from numpy.typing import ArrayLike, NDArray

    Floats = NDArray[np.float64]
    Times = NDArray[np.int64]
    Places = NDArray[np.intp]
    Way = tuple[str, ...]  # names of frames, each the parent of the one before

_S: Final = 1e9
_NEARLY_PARALLEL = 1 - 1e-12
"""Cosine of half an angle that counts as the largest; nearer rotations are mixed as at it."""


class Transform(Struct, frozen=True, eq=False):
    """Takes points from the source frame to the target frame; NaN where none is known.

    Attributes:
        translation: float64[3] or float64[n, 3], m.
        rotation: float64[4] or float64[n, 4], a unit quaternion in the order x, y, z, w.
    """

    translation: Floats
    rotation: Floats

    def __len__(self) -> int:
        """Number of transforms."""
        return len(self.translation)

    @property
    def is_known(self) -> NDArray[np.bool_]:
        """bool[n], or bool[] of one: where there is a transform."""
        return ~np.isnan(self.translation[..., 0])

    def matrix(self) -> Floats:
        """Homogeneous matrices, float64[4, 4] or float64[n, 4, 4]."""
        made = np.zeros((*self.rotation.shape[:-1], 4, 4))
        made[..., :3, :3] = np.stack([rotated(self.rotation, one) for one in np.eye(3)], axis=-1)
        made[..., :3, 3] = self.translation
        made[..., 3, 3] = 1
        return made

    def rpy(self) -> Floats:
        """Roll, pitch and yaw about the fixed axes x, y, z: float64[3] or float64[n, 3], rad."""
        x, y, z, w = np.moveaxis(self.rotation, -1, 0)
        roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return np.stack([roll, pitch, yaw], axis=-1)

    def apply(self, points: ArrayLike) -> Floats:
        """Points in the target frame.

        Args:
            points: [..., 3] in the source frame, m; of n transforms the first dimension is n.
        """
        given = np.asarray(points, np.float64)
        rotation, translation = self.rotation, self.translation
        if rotation.ndim == 2:
            between = (1,) * (given.ndim - 2)
            rotation = rotation.reshape(len(rotation), *between, 4)
            translation = translation.reshape(len(translation), *between, 3)
        return rotated(rotation, given) + translation

    def inverse(self) -> Transform:
        """The transforms from the target frame to the source frame."""
        back = self.rotation * np.array((-1.0, -1.0, -1.0, 1.0))
        return Transform(-rotated(back, self.translation), back)

    def __matmul__(self, first: Transform) -> Transform:
        """`a @ b`: `b`, then `a`."""
        return Transform(
            rotated(self.rotation, first.translation) + self.translation,
            _product(self.rotation, first.rotation),
        )


def identity(count: int) -> Transform:
    """Transforms that change nothing."""
    rotation = np.zeros((count, 4))
    rotation[:, 3] = 1
    return Transform(np.zeros((count, 3)), rotation)


def unknown(count: int) -> Transform:
    """Transforms that are not known."""
    return Transform(np.full((count, 3), np.nan), np.full((count, 4), np.nan))


def placed(pose: Any) -> Transform:
    """The transform of a pose of a message, of which JSON may have a part only."""
    at, turn = (getattr(pose, name, None) for name in ("position", "orientation"))
    rotation = np.array([float(getattr(turn, axis, 0)) for axis in "xyzw"])
    length = np.linalg.norm(rotation)
    # All zero is what protobuf has where nothing was set.
    unit = rotation / length if length else identity(1).rotation[0]
    return Transform(np.array([float(getattr(at, axis, 0)) for axis in "xyz"]), unit)


def rotated(rotation: Floats, points: Floats) -> Floats:
    """Points turned by unit quaternions: float64[..., 3]."""
    qx, qy, qz, qw = np.moveaxis(rotation, -1, 0)
    x, y, z = np.moveaxis(points, -1, 0)
    # Twice the cross product of axis and point; np.cross takes three times as long.
    tx, ty, tz = 2 * (qy * z - qz * y), 2 * (qz * x - qx * z), 2 * (qx * y - qy * x)
    return np.stack(
        [
            x + qw * tx + qy * tz - qz * ty,
            y + qw * ty + qz * tx - qx * tz,
            z + qw * tz + qx * ty - qy * tx,
        ],
        axis=-1,
    )


def interpolated(before: Transform, after: Transform, share: Floats) -> Transform:
    """Between pairs of transforms: straight translation, spherical rotation the shorter way.

    The share is 0 for `before` and 1 for `after`.
    """
    part = share[:, None]
    translation = before.translation + part * (after.translation - before.translation)
    cosine = np.einsum("ij,ij->i", before.rotation, after.rotation)
    way = np.where(cosine < 0, -1.0, 1.0)
    cosine = np.minimum(np.abs(cosine), _NEARLY_PARALLEL)
    sine = np.sqrt(1 - cosine * cosine)
    angle = share * np.arccos(cosine)
    second = np.sin(angle) / sine
    first = np.cos(angle) - cosine * second
    rotation = first[:, None] * before.rotation + (way * second)[:, None] * after.rotation
    rotation /= np.sqrt(np.einsum("ij,ij->i", rotation, rotation))[:, None]
    return Transform(translation, rotation)


def _product(a: Floats, b: Floats) -> Floats:
    """The rotation `b`, then `a`."""
    ax, ay, az, aw = np.moveaxis(a, -1, 0)
    bx, by, bz, bw = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ],
        axis=-1,
    )


class Frame(Struct, frozen=True, eq=False):
    """A frame, and its transforms to its parent.

    Attributes:
        name: Its name, without a leading slash.
        parents: Its parents, the latest last; usually one.
        is_static: True if a transform holds until another one comes, the first at all times before.
        stamps: int64[n], ascending, ns; of a static frame the log times of its transforms that
            differ from the one before.
        parent: intp[n], the place in `parents` of each.
        poses: The n transforms from the frame to its parent.
        late: Transforms more than 100 ms older than one that came before them.
        conflict: The parents that different topics give it at the same time, as words; it has no
            transform then.
    """

    name: str
    parents: tuple[str, ...]
    is_static: bool
    stamps: Times
    parent: Places
    poses: Transform
    late: int = 0
    conflict: str = ""

    @property
    def rate_hz(self) -> float | None:
        """Transforms a second; None of less than two, and of a static frame."""
        if self.is_static or len(self.stamps) < 2:
            return None
        return float((len(self.stamps) - 1) / ((self.stamps[-1] - self.stamps[0]) / _S))

    def longest_gap(self) -> tuple[int, int] | None:
        """Begin and end of the longest time between two transforms, ns."""
        if self.is_static or len(self.stamps) < 2:
            return None
        place = int(np.diff(self.stamps).argmax())
        return int(self.stamps[place]), int(self.stamps[place + 1])

    def parent_at(self, times: Times) -> Places:
        """The place in `parents` at each time: that of the latest transform, or the first."""
        if len(self.parents) == 1:
            return np.broadcast_to(self.parent[-1], times.shape)
        return self.parent[np.maximum(self.stamps.searchsorted(times, "right") - 1, 0)]

    def pose_at(self, times: Times) -> Transform:
        """The transforms to the parent at some times; NaN where there are none."""
        stamps = self.stamps
        if self.is_static:
            place = np.maximum(stamps.searchsorted(times, "right") - 1, 0)
            return Transform(self.poses.translation[place], self.poses.rotation[place])
        last = len(stamps) - 1
        before = np.clip(stamps.searchsorted(times, "right") - 1, 0, last)
        after = np.minimum(before + 1, last)
        # As integers, since times of today are no exact doubles. A new parent begins anew.
        step = np.maximum(stamps[after] - stamps[before], 1)
        share = np.clip((times - stamps[before]) / step, 0, 1)
        share[self.parent[before] != self.parent[after]] = 0
        translation, rotation = self.poses.translation, self.poses.rotation
        found = interpolated(
            Transform(translation[before], rotation[before]),
            Transform(translation[after], rotation[after]),
            share,
        )
        outside = (times < stamps[0]) | (times > stamps[-1])
        found.translation[outside] = found.rotation[outside] = np.nan
        return found

    def why_not(self, times: Times) -> Iterator[tuple[str, NDArray[np.bool_]]]:
        """Reasons why there is no transform, and at which of the times."""
        if self.conflict:
            yield self.conflict, np.ones(len(times), np.bool_)
        elif not self.is_static:
            begin, end = self.stamps[[0, -1]].tolist()
            yield f"before the first transform of {self.name}, {format_time(begin)}", times < begin
            yield f"after the last transform of {self.name}, {format_time(end)}", times > end


class Lookup(Transform, frozen=True, eq=False):
    """Transforms at many times; NaN where there is none.

    Attributes:
        times: int64[n], ns.
        missing: Number of times without a transform, by reason.
    """

    times: Times
    missing: Mapping[str, int] = field(default_factory=dict)

    def _repr_html_(self) -> str:
        return arrow_html(counted(len(self.times), "transform"), self.to_arrow())

    def to_arrow(self) -> pa.Table:
        """A row for each time: translation (m), quaternion, and roll, pitch and yaw (rad)."""
        import pyarrow as pa

        columns = np.concatenate([self.translation, self.rotation, self.rpy()], axis=1)
        unknown = ~self.is_known
        names = ("x", "y", "z", "qx", "qy", "qz", "qw", "roll", "pitch", "yaw")
        return pa.table(
            {
                "time": pa.array(self.times, pa.timestamp("ns", "UTC")),
                **{
                    name: pa.array(column, mask=unknown)
                    for name, column in zip(names, columns.T, strict=True)
                },
            }
        )


class FrameTree(Struct, frozen=True, eq=False):
    """The frames of a recording.

    Attributes:
        frames: The frames that have a parent, by name.
        span: Log time `[begin, end)` of the recording, ns: the origin of relative times.
        invalid: Transforms that were left out, by reason.
        remarks: What the transforms lack, such as lost messages.
    """

    frames: Mapping[str, Frame]
    span: tuple[int, int] = (0, 0)
    invalid: Mapping[str, int] = field(default_factory=dict)
    remarks: Sequence[str] = ()

    def __repr__(self) -> str:
        return f"<FrameTree {listed(self.names, 5)}>"

    @property
    def names(self) -> list[str]:
        """All frames: roots first, then each below its parent."""
        return [name for name, _ in self.walk()]

    @property
    def roots(self) -> list[str]:
        """Frames without a parent."""
        parents = dict.fromkeys(name for one in self.frames.values() for name in one.parents)
        return [name for name in parents if name not in self.frames]

    def walk(self) -> Iterator[tuple[str, int]]:
        """Each frame once with its depth, parents before children; a loop is entered at a frame."""
        below: dict[str, list[str]] = {}
        for one in self.frames.values():
            below.setdefault(one.parents[-1], []).append(one.name)
        seen: set[str] = set()
        for start in (*self.roots, *self.frames):
            ahead = [(start, 0)]
            while ahead:
                name, depth = ahead.pop()
                if name not in seen:
                    seen.add(name)
                    yield name, depth
                    ahead += [(child, depth + 1) for child in reversed(below.get(name, ()))]

    def problems(self) -> list[str]:
        """Sentences about several trees, frames of two parents, and transforms left out."""
        found = [
            f"{counted(number, 'transform')} left out: {why}."
            for why, number in self.invalid.items()
        ]
        for one in self.frames.values():
            if one.conflict:
                found.append(f"{one.conflict[0].upper()}{one.conflict[1:]}: it has no transform.")
            if one.is_static and len(one.stamps) > 1:
                found.append(
                    f"{one.name} is static and changed {counted(len(one.stamps) - 1, 'time')}: "
                    f"until {format_time(int(one.stamps[1]))} its first transform holds, then "
                    "each from its log time on."
                )
            if len(one.parents) > 1:
                found.append(f"{one.name} has several parents: {listed(one.parents)}.")
        if len(self.roots) > 1:
            found.append(
                f"The frames are {len(self.roots)} trees, with the roots {listed(self.roots)}."
            )
        return found

    def lookup(self, target: str, source: str, times: ArrayLike) -> Lookup:
        """Transforms from one frame to another.

        Args:
            target: The frame of the results.
            source: The frame in which points are given.
            times: n times on the clock of header stamps: integers, ns since the epoch, or
                datetimes of numpy, pandas or Arrow. Zero is not set, and has no transform.

        Returns:
            n transforms, NaN where none is known, with the reasons.

        Raises:
            TopicError: no such frame.
            UsageError: `times` are floats or texts.
        """
        wanted, given = self.check(target), self.check(source)
        times = _nanoseconds(times)
        made = unknown(len(times))
        known = np.flatnonzero(times)
        unset = len(times) - len(known)
        missing = Counter({"a stamp of zero, which is not set": unset} if unset else {})
        for rows, upwards in self._paths(given, times, known, ()):
            for own, downwards in self._paths(wanted, times, rows, ()):
                used = _until_common(upwards, downwards)
                if used is None:
                    missing[f"no way between {given} and {wanted}"] += len(own)
                    continue
                found = self._between(used, times[own], missing)
                made.translation[own], made.rotation[own] = found.translation, found.rotation
        return Lookup(made.translation, made.rotation, times, dict(missing))

    def latest(self, target: str, source: str) -> int:
        """The latest time with a transform from one frame to another, ns.

        Raises:
            TopicError: no such frame.
            TransformError: No way between the frames, at no time a transform.
        """
        end = np.array([self.span[1] - 1])
        ways = [
            next(self._paths(self.check(name), end, np.arange(1), ()))[1]
            for name in (source, target)
        ]
        used = _until_common(*ways)
        if used is None:
            raise TransformError(f"There is no way between {source} and {target}.")
        frames = [self.frames[name] for way in used for name in way]
        moving = [int(one.stamps[-1]) for one in frames if not one.is_static]
        return min(moving, default=int(end[0]))

    def _repr_html_(self) -> str:
        return arrow_html(counted(len(self.frames), "frame"), self.to_arrow())

    def to_arrow(self) -> pa.Table:
        """A row for each frame, parents first."""
        import pyarrow as pa

        stamp = pa.timestamp("ns", "UTC")
        kinds = {
            "frame": pa.string(), "parent": pa.string(), "depth": pa.int64(),
            "is_static": pa.bool_(), "transforms": pa.int64(), "rate_hz": pa.float64(),
            "first": stamp, "last": stamp, "longest_gap_ns": pa.int64(), "longest_gap_begin": stamp,
        }  # fmt: skip
        rows: list[dict[str, object]] = []
        for name, depth in self.walk():
            rows.append({"frame": name, "depth": depth})
            if (one := self.frames.get(name)) is None:
                continue
            rows[-1] |= {"parent": one.parents[-1], "is_static": one.is_static}
            rows[-1] |= {"transforms": len(one.stamps), "rate_hz": one.rate_hz}
            if not one.is_static:
                rows[-1] |= {"first": int(one.stamps[0]), "last": int(one.stamps[-1])}
            if (gap := one.longest_gap()) is not None:
                rows[-1] |= {"longest_gap_ns": gap[1] - gap[0], "longest_gap_begin": gap[0]}
        return pa.Table.from_pylist(rows, pa.schema(kinds))

    def transform(self, target: str, source: str, time: TimeLike) -> Transform:
        """The transform from one frame to another at one time, such as `+3s`; see `lookup`.

        Raises:
            TransformError: There is none at this time, or no way between the frames.
        """
        start, end = self.span
        at = parse_time(time, start=start, end=end)
        found = self.lookup(target, source, [at])
        if found.missing:
            raise TransformError(
                f"There is no transform from {source} to {target} at {format_time(at)}: "
                f"{next(iter(found.missing))}."
            )
        return Transform(found.translation[0], found.rotation[0])

    def check(self, name: str) -> str:
        """The name of a frame as the tree has it.

        Raises:
            TopicError: There is no such frame.
        """
        wanted = name.removeprefix("/")
        if wanted not in self.frames and all(wanted not in f.parents for f in self.frames.values()):
            known = listed(self.names) or "none"
            raise TopicError(f"There is no frame {name!r}; there are {known}.")
        return wanted

    def _paths(
        self, name: str, times: Times, rows: Places, below: Way
    ) -> Iterator[tuple[Places, Way]]:
        """The way from a frame to its root, for each group of times that share it.

        The last name of a way is the root, or the frame at which a loop closes.
        """
        way = (*below, name)
        one = self.frames.get(name)
        if one is None or name in below:
            yield rows, way
            return
        parent = one.parent_at(times[rows])
        for place in np.unique(parent):
            yield from self._paths(one.parents[place], times, rows[parent == place], way)

    def _between(self, ways: tuple[Way, Way], at: Times, missing: Counter[str]) -> Transform:
        """The transforms at times that share both ways; counts those that are missing."""
        parts = []
        for way in ways:
            part = identity(len(at))
            for name in way:
                part = self.frames[name].pose_at(at) @ part
            parts.append(part)
        found = parts[1].inverse() @ parts[0]
        left = ~found.is_known
        for name in (*ways[0], *ways[1]):
            for why, where in self.frames[name].why_not(at):
                if number := int((left & where).sum()):
                    missing[why] += number
                left &= ~where
        return found


def _until_common(upwards: Way, downwards: Way) -> tuple[Way, Way] | None:
    """Both ways up to the first frame that they share, without it; None if they share none."""
    common = next((name for name in upwards if name in downwards), None)
    if common is None:
        return None
    return upwards[: upwards.index(common)], downwards[: downwards.index(common)]


def _nanoseconds(times: ArrayLike) -> Times:
    """Times as integers, ns."""
    found = np.asarray(times)
    if found.dtype == object or found.dtype.kind == "M":  # pandas keeps zones in objects
        with suppress(TypeError, ValueError):
            found = np.asarray(times, "datetime64[ns]")
    if found.size and found.dtype.kind not in "iuM":
        raise UsageError("Times are whole nanoseconds since 1970, or datetimes.")
    return np.ascontiguousarray(found.reshape(-1), np.int64)
