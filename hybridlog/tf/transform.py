"""Rigid transforms as numpy arrays: one, or one for each of many times."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import Struct

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    Floats = NDArray[np.float64]

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
        made[..., :3, :3] = _matrices(self.rotation)
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


def _matrices(rotation: Floats) -> Floats:
    x, y, z, w = np.moveaxis(rotation, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
