"""What the simulated robot carries and how fast it talks."""

from __future__ import annotations

from dataclasses import dataclass

from hybridlog_storage.errors import UsageError

DEFAULT_DURATION_S = 60.0
DEFAULT_SEED = 1


@dataclass(frozen=True, slots=True)
class RobotConfig:
    """Sensors and rates; the defaults make about 100 MB a minute.

    A rate of 0 leaves the topic out. All rates are in hertz.

    Attributes:
        cameras: Number of cameras: front (`bgr8`), rear, left, right (`mono8`).
        image_size: Width and height of each image in pixels.
        image_hz: Rate of the front camera.
        mono_hz: Rate of the other cameras.
        scan_hz: Rate of the laser scanner.
        scan_beams: Beams of a scan.
        cloud_hz: Rate of the 3D lidar.
        cloud_columns: Directions round the 3D lidar; each has 16 points.
        imu_hz: Rate of the inertial measurement unit.
        odom_hz: Rate of odometry, transforms and joint states.
        cmd_hz: Rate of the velocity commands.

    Raises:
        UsageError: A value is out of its range.
    """

    cameras: int = 2
    image_size: tuple[int, int] = (320, 240)
    image_hz: float = 5.0
    mono_hz: float = 2.5
    scan_hz: float = 20.0
    scan_beams: int = 720
    cloud_hz: float = 0.5
    cloud_columns: int = 1250
    imu_hz: float = 100.0
    odom_hz: float = 50.0
    cmd_hz: float = 20.0

    def __post_init__(self) -> None:
        """Check every value, before anything is allocated."""
        _check("cameras", self.cameras, 0, 4)
        for side in self.image_size:
            _check("image_size", side, 16, 4096)
        _check("scan_beams", self.scan_beams, 8, 20_000)
        _check("cloud_columns", self.cloud_columns, 8, 20_000)
        for name in ("image_hz", "mono_hz", "scan_hz", "cloud_hz", "cmd_hz"):
            _check(name, getattr(self, name), 0, 1_000)
        for name in ("imu_hz", "odom_hz"):
            _check(name, getattr(self, name), 0, 100_000)


def _check(name: str, value: float, low: float, high: float) -> None:
    # Written so that NaN fails as well.
    if not low <= value <= high:
        raise UsageError(f"robot setting {name} is {value}; it must lie in {low} to {high}")
