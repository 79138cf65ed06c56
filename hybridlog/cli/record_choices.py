"""The parameters of `hybridlog record`, and the rules for giving them together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

from hybridlog.cli import output
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.options import check_latched
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from hybridlog.store import Store
    from hybridlog_storage.segments.segment_writer import SegmentSettings

DEFAULT_CHUNK: Final = 2 << 20
"""Bytes of a chunk."""


@dataclass(frozen=True, slots=True)
class RecordChoices:
    """The parameters as typed.

    Attributes:
        live_options: The options for live recording that were given.
    """

    paths: tuple[Path, ...]
    store: Path | None
    topics: tuple[str, ...]
    exclude: tuple[str, ...]
    no_index: tuple[str, ...]
    between: tuple[str, str] | None
    no_latched: bool
    original_times: bool
    name: str | None
    tag: tuple[str, ...]
    again: bool
    watch: bool
    settle: str
    chunk_size: str | None
    compression: str
    level: int
    ros1: bool
    master: str | None
    ros2: bool
    qos: Path | None
    foxglove: str | None
    replay: Path | None
    speed: float
    duration: str | None
    max_messages: int | None
    max_size: str | None
    split_size: str
    split_duration: str
    use_sim_time: bool
    throttle: tuple[str, ...]
    priority: tuple[str, ...]
    budget: str | None
    reserve: str
    flush_interval: str
    ring: str | None
    trigger: tuple[str, ...]
    before: str | None
    after: str | None
    contract: Path | None
    on_breach: str | None
    shared: bool
    mongo: str | None
    cache_size: int | None
    as_json: bool
    quiet: bool
    live_options: tuple[str, ...]

    @property
    def is_live(self) -> bool:
        """True when a source of live messages is given."""
        return self.is_ros1 or self.ros2 or self.foxglove is not None or self.replay is not None

    @property
    def is_ros1(self) -> bool:
        """True when a ROS 1 robot is recorded."""
        return self.ros1 or self.master is not None


def check_choices(choices: RecordChoices) -> None:
    """Refuse parameters that do not fit together.

    Raises:
        UsageError: A log and a robot at once, neither of them, or options of the other.
    """
    _check_sources(choices)
    if not choices.is_live:
        if choices.name is not None and len(choices.paths) > 1:
            raise UsageError("--name names one recording: give one path, or leave it out.")
        check_latched(
            no_latched=choices.no_latched, original_times=choices.original_times, form=None
        )
        _check_watch(choices)
        return
    if choices.watch:
        raise UsageError("--watch is for directories of logs, not for a running robot.")
    if choices.between is not None or choices.again:
        raise UsageError("--between and --again are for logs, not for a running robot.")
    if choices.no_latched or choices.original_times:
        raise UsageError("--no-latched and --original-times are for --between, and logs.")
    if choices.master is not None and not choices.master.strip():
        raise UsageError("A ROS master's URI looks like http://host:11311; this one is empty.")
    if choices.on_breach is not None and choices.contract is None:
        raise UsageError("--on-breach is for --contract.")
    if choices.qos is not None and not choices.ros2:
        raise UsageError("--qos is for --ros2.")
    if "--speed" in choices.live_options and choices.replay is None:
        raise UsageError("--speed is for --replay.")


def _check_watch(choices: RecordChoices) -> None:
    if not choices.watch:
        return
    if choices.name is not None:
        raise UsageError("--name names one recording; --watch makes many: leave it out.")
    for path in choices.paths:
        if not path.is_dir():
            raise UsageError(f"--watch takes directories, and {path} is none.")


def _check_sources(choices: RecordChoices) -> None:
    if choices.paths and choices.is_live:
        hint = ""
        if choices.is_ros1 and choices.master is None:
            hint = " A ROS master's URI looks like http://host:11311, and follows --ros1."
        raise UsageError(
            f"Give either logs to record or a robot (--ros1, --ros2, …), not both.{hint}"
        )
    if choices.paths and choices.live_options:
        are = "is" if len(choices.live_options) == 1 else "are"
        raise UsageError(
            f"{_listed(choices.live_options)} {are} for a running robot (--ros1, --ros2, "
            "--foxglove) or --replay, not for logs."
        )
    if not choices.paths and not choices.is_live:
        raise UsageError(
            "Nothing to record: give a log, or --ros1, --ros2, --foxglove URL or --replay FILE."
        )


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def segment_settings(choices: RecordChoices, chunk_size: int = DEFAULT_CHUNK) -> SegmentSettings:
    """Chunks and compression.

    Args:
        choices: The parameters.
        chunk_size: Bytes of a chunk if the user does not say.

    Raises:
        UsageError: The chunk size is no size.
    """
    from hybridlog_storage.segments.segment_writer import SegmentSettings

    return SegmentSettings(
        chunk_size=chunk_size
        if choices.chunk_size is None
        else output.parse_size(choices.chunk_size),
        compression=cast(Any, choices.compression),
        level=choices.level,
    )


def opened_to_record(
    choices: RecordChoices, *, recover: bool = True
) -> AbstractContextManager[Store]:
    """The store, which is made if there is none; see `opened_store`."""
    return opened_store(
        choices.store,
        choices.mongo,
        create=True,
        shared=choices.shared,
        cache_mb=choices.cache_size,
        quiet=choices.quiet,
        is_lasting=True,
        records=True,
        recover=recover,
    )
