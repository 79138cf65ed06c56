"""JPEG images that a camera of a robot would send."""

from __future__ import annotations

import io
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from benchmarks.loads.simulation.camera import Camera
from benchmarks.loads.simulation.robot import Robot
from hybridlog_storage.errors import MissingDependencyError

_SIZE = (640, 480)
_QUALITY = 80
"""What the image transport of ROS sets unless told otherwise."""
_COUNT = 16
_STEP_S = 0.1


class Jpegs:
    """A short drive, seen by a camera, shown forwards and backwards for ever.

    Args:
        seed: Of the drive.

    Raises:
        MissingDependencyError: Pillow is not installed.
    """

    def __init__(self, seed: int) -> None:
        try:
            from PIL import Image
        except ImportError as error:
            raise MissingDependencyError(
                "JPEG images need Pillow; install it with: pip install 'hybridlog[images]'"
            ) from error
        robot = Robot(60.0, seed)
        camera = Camera(_SIZE, 0.0, 0.1, colour=True)
        width, height = _SIZE
        frames = np.empty((_COUNT, height * width * 3), np.uint8)
        seconds = 8.0 + _STEP_S * np.arange(_COUNT, dtype=np.float64)
        camera.render(robot, seconds, frames, np.random.default_rng([seed, 0x19E6]))
        self.pictures: list[NDArray[np.uint8]] = []
        """Each as a JPEG file, uint8[size]."""
        for frame in frames.reshape(_COUNT, height, width, 3):
            stream = io.BytesIO()
            colours = np.ascontiguousarray(frame[:, :, ::-1])
            Image.fromarray(colours).save(stream, "JPEG", quality=_QUALITY)
            self.pictures.append(np.frombuffer(stream.getvalue(), np.uint8))

    def shown(self, count: int) -> Iterator[tuple[NDArray[np.uint8], NDArray[np.int64]]]:
        """Which of `count` messages show which picture.

        Yields:
            A picture, and int64[n], the numbers of the messages that show it.
        """
        turn = np.arange(count) % (2 * _COUNT - 2)
        picture = np.where(turn < _COUNT, turn, 2 * _COUNT - 2 - turn)
        for number, data in enumerate(self.pictures):
            rows = np.flatnonzero(picture == number)
            if len(rows):
                yield data, rows
