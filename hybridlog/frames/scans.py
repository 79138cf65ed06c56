"""Answers of laser scans as one numpy array, from columns of their fields."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hybridlog.arrays.message_arrays import plain_type
from hybridlog.arrays.point_arrays import scans_of
from hybridlog.frames.answer import FIXED, to_arrow

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from hybridlog.query.planner import Planner
    from hybridlog.query.question import RecordedChannel

FIELDS: Final = ("angle_min", "angle_increment", "ranges", "intensities")
"""The fields of a scan that its array is made of."""


def are_scans(channels: Sequence[RecordedChannel]) -> bool:
    """True if all messages are laser scans of one topic, with the usual fields."""
    return (
        bool(channels)
        and len({c.channel.topic for c in channels}) == 1
        and all(
            channel.encoding in FIXED
            and channel.channel.schema is not None
            and plain_type(channel.channel.schema.name) == "sensor_msgs/LaserScan"
            and channel.codec.reason is None
            and {path.path for path in channel.codec.paths()}.issuperset(FIELDS)
            for channel in channels
        )
    )


def scans_in(planner: Planner) -> NDArray[Any] | None:
    """The scans of an answer, in order.

    Args:
        planner: Planner of a question about the `FIELDS`.

    Returns:
        Shape (messages, ranges), rows as of `Message.to_numpy`; None if lengths differ, or
        there are no scans.
    """
    found = []
    for batch in to_arrow(planner).to_batches():
        start, step = (batch.column(name).to_numpy() for name in FIELDS[:2])
        arrays = [batch.column(name) for name in FIELDS[2:]]
        if not all(hasattr(array, "offsets") for array in arrays):
            return None
        (ranges, sizes), (intensities, given) = (
            (array.flatten().to_numpy(), np.diff(array.offsets.to_numpy())) for array in arrays
        )
        is_even = bool((sizes == sizes[0]).all() and ((given == sizes).all() or not given.any()))
        if not is_even:
            return None
        shape = len(sizes), int(sizes[0])
        measured = intensities.reshape(shape) if len(intensities) else None
        found.append(scans_of(start, step, ranges.reshape(shape), measured))
    alike = {(block.shape[1], block.dtype) for block in found}
    if len(alike) != 1:
        return None
    return found[0] if len(found) == 1 else np.concatenate(found)
